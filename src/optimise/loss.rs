//! What a view should look like, and the weights of the loss.

use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::gpu::{Gpu, GpuBuffer, GpuError};

/// Weights of the image loss `(1-λ)·L1 + λ·(1-SSIM) + λ_depth·L1(depth)`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// λ, the share of SSIM against L1 (3DGS: 0.2).
    pub ssim_weight: f32,
    /// λ_depth, per metre of depth error.
    pub depth_weight: f32,
    /// Depth beyond which λ_depth falls with the depth's square, as the precision of structured light and stereo does, metres.
    pub precise_depth_metres: f32,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self { ssim_weight: 0.2, depth_weight: 0.4, precise_depth_metres: 4.0 }
    }
}

/// First pixel along x and y with a window of SSIM, 0 or 1, when `steps` have been taken: one step evaluates every second window of every
/// second row.
pub fn ssim_phase(steps: usize) -> [u32; 2] {
    // Top bits of a multiplicative hash (Knuth, TAOCP 6.4): no period that a shuffled epoch could share.
    let bits = (steps as u32).wrapping_mul(0x9E37_79B9) >> 30;
    [bits & 1, bits >> 1]
}

impl LossConfig {
    /// Says what is wrong with the values, if anything.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        if !(0.0..=1.0).contains(&self.ssim_weight) {
            return Err("ssim_weight must lie between 0 and 1".into());
        }
        if !(self.depth_weight.is_finite() && self.depth_weight >= 0.0) {
            return Err("depth_weight must be finite and not negative".into());
        }
        if self.precise_depth_metres > 0.0 { Ok(()) } else { Err("precise_depth_metres must be positive".into()) }
    }
}

/// Mean loss terms of one view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossTerms {
    /// Mean |colour error| and mean SSIM over pixels and channels.
    pub l1: f32,
    /// Mean structural similarity, 1 for equal images.
    pub ssim: f32,
    /// Mean |Σ w z - α·sensor depth| over all pixels, each weighted by the sensor's precision, metres.
    pub depth_metres: f32,
    /// Mean squared colour error.
    pub mse: f32,
}

impl LossTerms {
    pub(super) fn from_sums(sums: [f32; 4], pixels: u32) -> Self {
        let pixels = pixels as f32;
        Self {
            l1: sums[0] / pixels / 3.0,
            ssim: sums[1] / pixels / 3.0,
            depth_metres: sums[2] / pixels,
            mse: sums[3] / pixels / 3.0,
        }
    }

    /// The weighted sum that is minimised.
    pub fn total(&self, config: &LossConfig) -> f32 {
        (1.0 - config.ssim_weight) * self.l1 + config.ssim_weight * (1.0 - self.ssim) + config.depth_weight * self.depth_metres
    }

    /// Peak signal-to-noise ratio of the colours, dB.
    pub fn psnr_db(&self) -> f32 {
        -10.0 * self.mse.max(1e-10).log10()
    }
}

/// A view's pixels on the host, as the GPU has them.
#[derive(Clone, Debug, PartialEq)]
pub struct Pixels {
    /// `[H * W]` 8-bit RGBA; A is 255, or the whole is 0 where the camera recorded nothing.
    pub color: Vec<u32>,
    /// `[H * W]` metres, 0 where not measured.
    pub depth_metres: Vec<f32>,
}

/// A view's pixels on the GPU.
#[derive(Debug)]
pub(super) struct GpuPixels {
    pub color: GpuBuffer,
    pub depth: GpuBuffer,
}

impl GpuPixels {
    /// A black image without depth.
    pub fn blank(gpu: &Gpu, (width, height): (u32, u32)) -> Result<Self, GpuError> {
        let bytes = u64::from(width) * u64::from(height) * 4;
        let plane = |label: &str| GpuBuffer::storage(gpu, label, bytes);
        Ok(Self { color: plane("target colour")?, depth: plane("target depth")? })
    }

    /// Becomes an image of the same size, before the next submission.
    pub fn write(&self, gpu: &Gpu, pixels: &Pixels) {
        self.color.write(gpu, 0, &pixels.color);
        self.depth.write(gpu, 0, &pixels.depth_metres);
    }
}

/// What a view should look like: 8-bit colour and sensor depth, on the GPU unless offloaded.
#[derive(Debug)]
pub struct TargetImage {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Nothing once offloaded.
    pub(super) pixels: Option<GpuPixels>,
}

impl TargetImage {
    /// Uploads an image and, where the sensor has one, its depth `[H * W]` in metres; pixels at 0 do not enter the depth loss.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Gpu, image: &RgbImage, depth_metres: Option<&[f32]>) -> Result<Self, GpuError> {
        Self::masked(gpu, image, depth_metres, None)
    }

    /// As [`Self::new`], of an image of which only the `valid` pixels `[H * W]` enter the loss.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn masked(gpu: &Gpu, image: &RgbImage, depth_metres: Option<&[f32]>, valid: Option<&[bool]>) -> Result<Self, GpuError> {
        let (width, height) = image.dimensions();
        let pixels = GpuPixels::blank(gpu, (width, height))?;
        let count = (width * height) as usize;
        assert!(valid.is_none_or(|valid| valid.len() == count), "the mask has the size of the image");
        let is_valid = |i: usize| valid.is_none_or(|valid| valid[i]);
        let colors = image.as_raw().chunks_exact(3).enumerate();
        let packed = colors.map(|(i, c)| if is_valid(i) { u32::from_le_bytes([c[0], c[1], c[2], 255]) } else { 0 });
        pixels.color.write_words(gpu, packed);
        if let Some(metres) = depth_metres {
            assert_eq!(metres.len(), count, "depth has the size of the image");
            let measured = metres.iter().enumerate().map(|(i, metres)| if is_valid(i) { metres.to_bits() } else { 0 });
            pixels.depth.write_words(gpu, measured);
        }
        Ok(Self { width, height, pixels: Some(pixels) })
    }

    /// Whether its pixels are on the GPU.
    pub fn is_resident(&self) -> bool {
        self.pixels.is_some()
    }

    /// Its pixels, read back; `None` if they are offloaded.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn read_pixels(&self, gpu: &Gpu) -> Result<Option<Pixels>, GpuError> {
        let count = (self.width * self.height) as usize;
        let read = |on_gpu: &GpuPixels| {
            let read = gpu.read(None, &[on_gpu.color.part::<u32>(0, count), on_gpu.depth.part::<f32>(0, count)])?;
            Ok(Pixels { color: read.part(0), depth_metres: read.part(1) })
        };
        self.pixels.as_ref().map(read).transpose()
    }

    /// Replaces its depth, `[H * W]` metres, unless it is offloaded.
    pub fn set_depth(&self, gpu: &Gpu, metres: &[f32]) {
        self.pixels.iter().for_each(|pixels| pixels.depth.write(gpu, 0, metres));
    }

    /// Frees its pixels on the GPU: from here on a [`TrainingView`](super::TrainingView) brings them along.
    pub fn offload(&mut self) {
        self.pixels = None;
    }
}
