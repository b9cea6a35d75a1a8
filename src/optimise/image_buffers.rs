//! Buffers of the image loss, for each size of view in turn.

use super::loss::{GpuPixels, Pixels, TargetImage};
use crate::gpu::{Gpu, GpuBuffer, GpuError};

/// Pixels along a side of what one workgroup of the loss shaders covers.
pub(super) const LOSS_TILE: u32 = 16;
const WINDOW_BORDER: u32 = 3;

/// Twin of the shaders' function: SSIM's windows along a side, with a border.
fn bordered_windows(size: u32) -> u64 {
    u64::from(size.next_multiple_of(LOSS_TILE) / 2 + 2 * WINDOW_BORDER)
}

/// Sizes of view that the optimiser keeps buffers for: whole and half, of upright and of level photos. Photos may have any number of sizes.
const SIZES_KEPT: usize = 4;

/// What the loss needs of a view's size. The partials' borders stay zero, so another size cannot share them.
#[derive(Debug)]
pub(super) struct ImageBuffers {
    pub size: (u32, u32),
    /// Pixels of an offloaded target, while a step uses it.
    streamed: Option<GpuPixels>,
    pub partials: GpuBuffer,
    pub gradients: GpuBuffer,
    /// [workgroups]; its length is the number of terms that are summed.
    pub loss_sums: GpuBuffer,
}

impl ImageBuffers {
    fn new(gpu: &Gpu, (width, height): (u32, u32), planes: u32) -> Result<Self, GpuError> {
        let tiles = width.div_ceil(LOSS_TILE) * height.div_ceil(LOSS_TILE);
        Ok(Self {
            size: (width, height),
            streamed: None,
            partials: GpuBuffer::storage(gpu, "loss partials", bordered_windows(width) * bordered_windows(height) * 48)?,
            gradients: GpuBuffer::storage(gpu, "image gradients", u64::from(width * height) * u64::from(planes) * 16)?,
            loss_sums: GpuBuffer::storage(gpu, "loss sums", u64::from(tiles) * 16)?,
        })
    }

    /// Uploads the pixels of an offloaded target, before the next submission.
    pub fn stream(&mut self, gpu: &Gpu, pixels: &Pixels) -> Result<(), GpuError> {
        self.prepare_to_stream(gpu)?.write(gpu, pixels);
        Ok(())
    }

    /// Makes the buffer for offloaded targets.
    pub fn prepare_to_stream(&mut self, gpu: &Gpu) -> Result<&GpuPixels, GpuError> {
        Ok(match &mut self.streamed {
            Some(streamed) => streamed,
            none => none.insert(GpuPixels::blank(gpu, self.size)?),
        })
    }

    /// Whether a target has been streamed.
    pub fn streams(&self) -> bool {
        self.streamed.is_some()
    }

    /// The pixels of a step's target: its own, or those that were streamed.
    pub fn pixels<'a>(&'a self, target: &'a TargetImage) -> &'a GpuPixels {
        target.pixels.as_ref().or(self.streamed.as_ref()).expect("a view brings an offloaded target along")
    }
}

/// Puts the buffers for `size` in front, made anew if they are not among the last few; gradients have so many `planes`.
pub(super) fn choose(kept: &mut Vec<ImageBuffers>, gpu: &Gpu, size: (u32, u32), planes: u32) -> Result<(), GpuError> {
    let place = kept.iter().position(|images| images.size == size);
    let images = place.map_or_else(|| ImageBuffers::new(gpu, size, planes), |place| Ok(kept.remove(place)))?;
    kept.insert(0, images);
    kept.truncate(SIZES_KEPT);
    Ok(())
}
