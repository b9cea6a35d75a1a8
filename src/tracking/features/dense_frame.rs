//! A frame's pixels for dense alignment: brightness and depth at a quarter of the recorded size, without lens distortion.

use crate::geometry::{Camera, Pinhole};
use crate::sequence::DepthImage;
use crate::tracking::TrackingConfig;

/// Of the recorded size.
pub const SCALE: f64 = 0.25;

/// A frame for dense alignment, `[height * width]` each.
#[derive(Clone, Debug)]
pub struct DenseFrame {
    pub pinhole: Pinhole,
    /// Metres, 0 where unknown.
    pub depth: Vec<f32>,
    pub grey: Vec<f32>,
}

impl DenseFrame {
    /// Host memory, bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(self.depth.as_slice()) + size_of_val(self.grey.as_slice())
    }
}

/// Where each pixel of the dense image lies in the recorded one, row-major.
#[derive(Clone, Debug)]
pub struct DenseSampler {
    pinhole: Pinhole,
    sources: Vec<Option<(u32, u32)>>,
}

impl DenseSampler {
    pub fn new(camera: &Camera) -> Self {
        let pinhole = camera.pinhole.scaled(SCALE);
        let full = &camera.pinhole;
        let source = |i: u32| {
            let ray = pinhole.unproject(&nalgebra::Vector2::new(f64::from(i % pinhole.width), f64::from(i / pinhole.width)), 1.0);
            let pixel = camera.distort_pixel(&full.project(&ray)?);
            full.contains(&pixel, 2.0).then(|| (pixel.x.round() as u32, pixel.y.round() as u32))
        };
        Self { sources: (0..pinhole.width * pinhole.height).map(source).collect(), pinhole }
    }

    /// Takes the samples of a frame: brightness as the mean of 4×4 pixels, depth as it is.
    pub fn sample(&self, grey: &[u8], depth: &DepthImage, config: &TrackingConfig) -> DenseFrame {
        let width = depth.width as usize;
        let mean = |(x, y): (u32, u32)| {
            let row = |v: usize| -> &[u8; 4] {
                grey[v * width + x as usize - 1..].first_chunk().expect("four pixels inside the image")
            };
            let sum: u16 = (y as usize - 1..y as usize + 3).map(|v| row(v).iter().map(|g| u16::from(*g)).sum::<u16>()).sum();
            f32::from(sum) / 16.0
        };
        let metres = |(x, y): (u32, u32)| {
            let found = depth.at(x, y).unwrap_or_default();
            let range = config.min_depth_metres..=config.max_depth_metres;
            if range.contains(&f64::from(found)) { found } else { 0.0 }
        };
        DenseFrame {
            pinhole: self.pinhole,
            depth: self.sources.iter().map(|s| s.map_or(0.0, metres)).collect(),
            grey: self.sources.iter().map(|s| s.map_or(0.0, mean)).collect(),
        }
    }
}
