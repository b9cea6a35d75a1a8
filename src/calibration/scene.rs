//! Scenes to measure on: made-up ones of any size (surfaces at several depths, filling the view in a few layers, as a mapped room
//! would), and views of real maps.

use std::sync::Arc;

use fastrand::Rng;
use glam::{Quat, Vec3};
use image::{Rgb, RgbImage};
use nalgebra::Vector2;

use crate::geometry::{Pinhole, Se3};
use crate::gpu::{Gpu, GpuError};
use crate::optimise::TargetImage;
use crate::render::GpuCloud;
use crate::splat::ViewCamera;
use crate::splat::{Gaussian, GaussianCloud, ShDegree, raw_opacity_from_opacity};

/// How often the Gaussians' footprints (one standard deviation) cover the image.
const LAYERS: f32 = 2.0;

/// A map, a camera, and what the camera should have seen.
#[derive(Debug)]
pub struct BenchScene {
    /// The map.
    pub cloud: GpuCloud,
    /// The view.
    pub camera: ViewCamera,
    /// The recorded image.
    pub target: TargetImage,
}

impl BenchScene {
    /// `count` Gaussians in view at `width`×`height`.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Arc<Gpu>, count: usize, (width, height): (u32, u32), sh_degree: ShDegree) -> Result<Self, GpuError> {
        let mut rng = Rng::with_seed(count as u64);
        let focal = f64::from(width) * 0.8;
        let (cx, cy) = (f64::from(width) / 2.0 - 0.5, f64::from(height) / 2.0 - 0.5);
        let pinhole = Pinhole { fx: focal, fy: focal, cx, cy, width, height };
        let mut cloud = GaussianCloud::new(sh_degree);
        for _ in 0..count {
            cloud.push(gaussian(&mut rng, &pinhole, count, sh_degree));
        }
        let on_gpu = GpuCloud::of(gpu, &cloud)?;
        let color = RgbImage::from_fn(width, height, |x, y| Rgb([(x * 7 + y) as u8, (y * 5) as u8, (x + y * 3) as u8]));
        let target = TargetImage::new(gpu, &color, Some(&vec![2.0; (width * height) as usize]))?;
        Ok(Self { cloud: on_gpu, camera: ViewCamera { pinhole, camera_from_world: Se3::identity() }, target })
    }

    /// A map from a view that was recorded.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn of_map(
        gpu: &Arc<Gpu>,
        cloud: &GaussianCloud,
        camera: ViewCamera,
        color: &RgbImage,
        depth_metres: Option<&[f32]>,
    ) -> Result<Self, GpuError> {
        let on_gpu = GpuCloud::of(gpu, cloud)?;
        let target = TargetImage::new(gpu, color, depth_metres)?;
        Ok(Self { cloud: on_gpu, camera, target })
    }
}

fn gaussian(rng: &mut Rng, pinhole: &Pinhole, count: usize, sh_degree: ShDegree) -> Gaussian {
    let (width, height) = (pinhole.width as f32, pinhole.height as f32);
    let pixel = Vector2::new(f64::from(rng.f32() * width), f64::from(rng.f32() * height));
    let metres = [1.0, 1.6, 2.3, 3.1][rng.usize(..4)] + 0.05 * rng.f32();
    let p = pinhole.unproject(&pixel, f64::from(metres));
    let sigma_pixels = (LAYERS * width * height / (count as f32 * std::f32::consts::PI)).sqrt();
    let sigma = sigma_pixels * metres / pinhole.fx as f32;
    let mut spread = || 0.6 * (rng.f32() - 0.5);
    let log_scale = Vec3::splat(sigma.ln()) + Vec3::new(spread(), spread(), spread() - 1.0);
    let mut unit = || 2.0 * rng.f32() - 1.0;
    Gaussian {
        mean: Vec3::new(p.x as f32, p.y as f32, p.z as f32),
        log_scale,
        rotation: Quat::from_xyzw(unit(), unit(), unit(), unit() + 0.01),
        raw_opacity: raw_opacity_from_opacity(0.55 + 0.4 * unit()),
        sh: (0..sh_degree.coefficients()).map(|k| Vec3::new(unit(), unit(), unit()) * if k == 0 { 1.5 } else { 0.1 }).collect(),
    }
}
