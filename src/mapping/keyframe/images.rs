//! A keyframe's image in the mapper: on the GPU or offloaded, whole and at half the size.

use std::borrow::Cow;

use image::{Rgb, RgbImage};

use crate::geometry::Pinhole;
use crate::gpu::{Gpu, GpuError};
use crate::mapping::MappingError;
use crate::mapping::image_store::{ImageStore, StoredImage};
use crate::optimise::{Pixels, TargetImage};
use crate::sequence::{DepthImage, RectifiedImage};

/// A keyframe's image, on the GPU or offloaded.
#[derive(Debug)]
pub(super) struct Images {
    pub whole: TargetImage,
    /// Target at half the size, where coarse steps use it.
    pub half: Option<TargetImage>,
    /// Pixels of both once they are offloaded.
    stored: Option<(StoredImage, Option<StoredImage>)>,
}

impl Images {
    /// Uploads an image; `with_half` also at half the size, if that is still an image worth comparing.
    pub fn new(gpu: &Gpu, image: &RectifiedImage, with_half: bool) -> Result<Self, GpuError> {
        let target = |image: &RectifiedImage| {
            let depth = image.depth.as_ref().map(|d| d.metres.as_slice());
            TargetImage::masked(gpu, &image.color, depth, image.valid.as_deref())
        };
        let worth = with_half && image.pinhole.width.min(image.pinhole.height) >= MIN_HALVED;
        Ok(Self { whole: target(image)?, half: worth.then(|| target(&halved(image))).transpose()?, stored: None })
    }

    /// Moves the pixels from the GPU to the store.
    pub fn offload(&mut self, gpu: &Gpu, store: &mut ImageStore) -> Result<(), GpuError> {
        let Self { whole, half, stored } = self;
        let Some(pixels) = whole.read_pixels(gpu)? else { return Ok(()) };
        let halved = half.as_ref().map_or(Ok(None), |half| half.read_pixels(gpu))?;
        *stored = Some((store.put(pixels), halved.map(|pixels| store.put(pixels))));
        whole.offload();
        half.iter_mut().for_each(TargetImage::offload);
        Ok(())
    }

    /// Pixels of the offloaded image, of the smaller one if `coarse` and there is one; `None` if they are on the GPU.
    pub fn streamed<'a>(&'a self, coarse: bool, store: &ImageStore) -> std::io::Result<Option<Cow<'a, Pixels>>> {
        let image = self.stored.as_ref().map(|(whole, half)| half.as_ref().filter(|_| coarse).unwrap_or(whole));
        image.map(|image| store.get(image)).transpose()
    }

    /// Depth, `[H, W]` metres, wherever it is.
    pub fn depth_metres(&self, gpu: &Gpu, store: &ImageStore) -> Result<Vec<f32>, MappingError> {
        Ok(match &self.stored {
            Some((whole, _)) => store.get(whole)?.into_owned().depth_metres,
            None => self.whole.read_pixels(gpu)?.map_or(Vec::new(), |pixels| pixels.depth_metres),
        })
    }

    /// Scales the depth, wherever it is. That at half the size follows from the whole one's, as it does in [`Self::new`], to the bit.
    pub fn scale_depth(&mut self, gpu: &Gpu, store: &mut ImageStore, scale: f64) -> Result<(), MappingError> {
        let Self { whole, half, stored } = self;
        let (width, height) = (whole.width, whole.height);
        let (stored_whole, stored_half) = stored.as_mut().map_or((None, None), |(whole, half)| (Some(whole), half.as_mut()));
        let metres = change_depth(gpu, store, Place { target: whole, stored: stored_whole }, |metres| {
            metres.iter_mut().for_each(|metres| *metres = (f64::from(*metres) * scale) as f32);
        })?;
        if let Some(half) = half {
            let halved = halved_depth(&DepthImage { width, height, metres });
            change_depth(gpu, store, Place { target: half, stored: stored_half }, |metres| {
                let measured = metres.iter_mut().zip(halved.metres).filter(|(metres, _)| **metres > 0.0);
                measured.for_each(|(to, metres)| *to = metres);
            })?;
        }
        Ok(())
    }
}

/// Where an image's pixels are: in the store, or on the GPU.
struct Place<'a> {
    target: &'a TargetImage,
    stored: Option<&'a mut StoredImage>,
}

/// Changes the depths of one image where they are, and returns them.
fn change_depth(
    gpu: &Gpu,
    store: &mut ImageStore,
    Place { target, stored }: Place<'_>,
    change: impl FnOnce(&mut Vec<f32>),
) -> Result<Vec<f32>, MappingError> {
    let Some(stored) = stored else {
        let mut metres = target.read_pixels(gpu)?.map_or(Vec::new(), |pixels| pixels.depth_metres);
        change(&mut metres);
        target.set_depth(gpu, &metres);
        return Ok(metres);
    };
    let mut pixels = store.get(stored)?.into_owned();
    change(&mut pixels.depth_metres);
    store.set_depth(stored, &pixels.depth_metres)?;
    Ok(pixels.depth_metres)
}

/// Shorter sides below this many pixels are not halved.
const MIN_HALVED: u32 = 64;

/// Pinhole of the half-size image; an odd last row or column is left out.
pub(super) fn halved_pinhole(p: &Pinhole) -> Pinhole {
    let half = |c: f64| (c + 0.5) * 0.5 - 0.5;
    Pinhole { fx: 0.5 * p.fx, fy: 0.5 * p.fy, cx: half(p.cx), cy: half(p.cy), width: p.width / 2, height: p.height / 2 }
}

/// Means of 2×2 pixels.
fn halved(image: &RectifiedImage) -> RectifiedImage {
    let pinhole = halved_pinhole(&image.pinhole);
    let color = RgbImage::from_fn(pinhole.width, pinhole.height, |x, y| {
        let sum = block(x, y)
            .map(|(x, y)| image.color.get_pixel(x, y).0.map(u32::from))
            .into_iter()
            .fold([2; 3], |sum, c| [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]]);
        Rgb(sum.map(|s| (s / 4) as u8))
    });
    let depth = image.depth.as_ref().map(halved_depth);
    let valid = image.valid.as_ref().map(|valid| {
        let width = image.pinhole.width;
        let all = |i: u32| block(i % pinhole.width, i / pinhole.width).iter().all(|(x, y)| valid[(y * width + x) as usize]);
        (0..pinhole.width * pinhole.height).map(all).collect()
    });
    RectifiedImage { pinhole, color, depth, valid }
}

/// Means of 2×2 depths that are measured and on the nearest surface.
fn halved_depth(depth: &DepthImage) -> DepthImage {
    let (width, height) = (depth.width / 2, depth.height / 2);
    let mean = |i: u32| {
        let measured = block(i % width, i / width).map(|(x, y)| depth.at(x, y).unwrap_or(f32::INFINITY));
        let nearest = measured.into_iter().fold(f32::INFINITY, f32::min);
        let near = || measured.iter().filter(|m| m.is_finite() && **m < SAME_SURFACE * nearest);
        let count = near().count();
        if count > 0 { near().sum::<f32>() / count as f32 } else { 0.0 }
    };
    DepthImage { width, height, metres: (0..width * height).map(mean).collect() }
}

/// The 2×2 pixels under one of half the size.
fn block(x: u32, y: u32) -> [(u32, u32); 4] {
    [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| (2 * x + dx, 2 * y + dy))
}

/// Depths within this factor of each other are on one surface.
const SAME_SURFACE: f32 = 1.1;
