//! Buffers of the image loss, for each size of view in turn.

use super::loss::GpuPixels;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::render::layout::{TILE_HEIGHT, TILE_WIDTH};

/// Pixels along a side of what one workgroup of the loss shaders covers.
pub(super) const LOSS_TILE: u32 = 16;
const WINDOW_BORDER: u32 = 3;

/// Twin of the shaders' function: SSIM's windows along a side, with a border.
fn bordered_windows(size: u32) -> u64 {
    u64::from(size.next_multiple_of(LOSS_TILE) / 2 + 2 * WINDOW_BORDER)
}

/// Tiles of an image, for which the loss is summed.
pub(super) fn tiles((width, height): (u32, u32)) -> usize {
    (width.div_ceil(TILE_WIDTH) * height.div_ceil(TILE_HEIGHT)) as usize
}

/// Sizes of view that the optimiser keeps buffers for: whole and half, of upright and of level photos. Photos may have any number of sizes.
const SIZES_KEPT: usize = 4;

/// What the loss needs of a view's size. The partials' borders stay zero, so another size cannot share them.
#[derive(Debug)]
pub(super) struct ImageBuffers {
    pub size: (u32, u32),
    /// The step's target, copied to one place: bind groups over each view's own buffers would be made anew all the time.
    pub target: GpuPixels,
    pub partials: GpuBuffer,
    pub gradients: GpuBuffer,
    /// [tiles] of the step's view, those of tiles left out from earlier steps; its length is the number of terms that are summed.
    pub loss_sums: GpuBuffer,
}

impl ImageBuffers {
    fn new(gpu: &Gpu, (width, height): (u32, u32)) -> Result<Self, GpuError> {
        Ok(Self {
            size: (width, height),
            target: GpuPixels::blank(gpu, (width, height))?,
            partials: GpuBuffer::storage(gpu, "loss partials", bordered_windows(width) * bordered_windows(height) * 48)?,
            gradients: GpuBuffer::storage(gpu, "image gradients", u64::from(width * height) * 32)?,
            loss_sums: GpuBuffer::storage(gpu, "loss sums", tiles((width, height)) as u64 * 16)?,
        })
    }
}

/// Puts the buffers for `size` in front, made anew if they are not among the last few.
pub(super) fn choose(kept: &mut Vec<ImageBuffers>, gpu: &Gpu, size: (u32, u32)) -> Result<(), GpuError> {
    let place = kept.iter().position(|images| images.size == size);
    let images = place.map_or_else(|| ImageBuffers::new(gpu, size), |place| Ok(kept.remove(place)))?;
    kept.insert(0, images);
    kept.truncate(SIZES_KEPT);
    Ok(())
}
