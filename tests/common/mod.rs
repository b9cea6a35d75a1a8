//! What test binaries share: random scenes for the gradient tests, and a tiny recording for those of the whole program.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod browser;
pub mod pairs;
pub mod recording;
pub mod requirements;
pub mod viewer;

use fastrand::Rng;
use glam::{Quat, Vec3};
use keysplat::geometry::{Pinhole, se3};
use keysplat::splat::ViewCamera;
use keysplat::splat::{Gaussian, GaussianCloud, ShDegree};
use keysplat::verification::reference::{Image64, ImageGradient64};
use nalgebra::{Vector3, Vector6};

pub fn between(rng: &mut Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.f32()
}

fn direction(rng: &mut Rng) -> Vec3 {
    Vec3::new(between(rng, -1.0, 1.0), between(rng, -1.0, 1.0), between(rng, -1.0, 1.0))
}

/// A camera with its principal point off the centre, somewhere near the origin, looking roughly along z.
pub fn camera(rng: &mut Rng, width: u32, height: u32) -> ViewCamera {
    let focal = f64::from(width) * 0.9;
    let tau = Vector6::from_fn(|_, _| f64::from(between(rng, -0.15, 0.15)));
    let pinhole =
        Pinhole { fx: focal, fy: focal * 1.03, cx: f64::from(width) * 0.47, cy: f64::from(height) * 0.54, width, height };
    ViewCamera { pinhole, camera_from_world: se3::exp(&tau) }
}

/// Gaussians of many sizes in front of the camera, some of them off the frustum, some faint, some nearly opaque.
pub fn scene(rng: &mut Rng, count: usize, sh_degree: ShDegree) -> GaussianCloud {
    let mut cloud = GaussianCloud::new(sh_degree);
    for _ in 0..count {
        let z = between(rng, 0.6, 4.0);
        let mean = Vec3::new(between(rng, -0.8, 0.8) * z, between(rng, -0.6, 0.6) * z, z);
        let size = between(rng, -4.5, -1.5);
        let sh = (0..sh_degree.coefficients()).map(|k| direction(rng) * if k == 0 { 1.5 } else { 0.4 }).collect();
        cloud.push(Gaussian {
            mean,
            log_scale: Vec3::splat(size) + direction(rng) * 0.8,
            rotation: Quat::from_xyzw(
                between(rng, -1.0, 1.0),
                between(rng, -1.0, 1.0),
                between(rng, -1.0, 1.0),
                between(rng, -1.0, 1.0),
            ),
            raw_opacity: between(rng, -3.0, 3.5),
            sh,
        });
    }
    cloud
}

/// A random gradient by the image, as a loss might give it.
pub fn image_gradient(rng: &mut Rng, pixels: usize) -> ImageGradient64 {
    let mut number = || f64::from(between(rng, -1.0, 1.0));
    ImageGradient64 {
        color: (0..pixels).map(|_| Vector3::new(number(), number(), number())).collect(),
        depth: (0..pixels).map(|_| number()).collect(),
        alpha: (0..pixels).map(|_| number()).collect(),
        surface: (0..pixels).map(|_| Vector3::new(number(), number(), number())).collect(),
    }
}

/// The linear loss that has this gradient.
pub fn linear_loss(image: &Image64, gradient: &ImageGradient64) -> f64 {
    (0..image.depth.len())
        .map(|i| {
            image.color[i].dot(&gradient.color[i])
                + image.depth[i] * gradient.depth[i]
                + (1.0 - image.transmittance[i]) * gradient.alpha[i]
                + image.surface[i].dot(&gradient.surface[i])
        })
        .sum()
}

/// ‖a - b‖ / ‖b‖.
pub fn relative_error(a: &[f64], b: &[f64]) -> f64 {
    let difference: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
    let norm: f64 = b.iter().map(|b| b * b).sum();
    (difference / norm.max(1e-300)).sqrt()
}
