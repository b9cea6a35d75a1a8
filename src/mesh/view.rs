//! A depth image made ready for fusion: inverse depth, and how the surface faces the camera.
//!
//! Inverse depth, because a plane's is linear over the image: interpolation between pixels, and the fit of a tangent plane, are exact for planes.
//! Depth edges are left out, as both sides of them are unreliable: sensors mix the surfaces, and so do blended Gaussians.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::geometry::{Pinhole, Se3};

/// Half the side of the window that a tangent plane is fitted to, pixels.
const WINDOW: isize = 2;
/// A pixel is at an edge where its inverse depth leaves the line between its neighbours by more than this share.
const EDGE: f32 = 0.04;
/// Pixels of the window that must lie on the surface.
const LEAST_SUPPORT: usize = 9;
/// Surfaces that are seen at a smaller cosine are left out: one pixel's error moves their depth by more than six pixel widths.
const LEAST_FACING: f32 = 0.15;
/// Nothing nearer is fused, metres.
const NEAR_METRES: f32 = 0.05;

/// A view's depth and colour.
#[derive(Clone, Debug)]
pub struct DepthView {
    /// Intrinsics.
    pub pinhole: Pinhole,
    /// Pose.
    pub world_from_camera: Se3,
    /// `[H, W]`, 1/metres along z; 0 where nothing is known.
    pub inverse_depth: Vec<f32>,
    /// `[H, W]` cosine between the surface's normal and the ray; 0 where nothing is known.
    pub facing: Vec<f32>,
    /// `[H, W]` sRGB.
    pub color: Vec<[u8; 3]>,
}

impl DepthView {
    /// From depth along z in metres, 0 where nothing is known, and colours.
    pub fn new(pinhole: Pinhole, world_from_camera: Se3, depth_metres: &[f32], color: Vec<[u8; 3]>) -> Self {
        let is_known = |z: f32| z.is_finite() && z > NEAR_METRES;
        let inverse: Vec<f32> = depth_metres.iter().map(|z| if is_known(*z) { z.recip() } else { 0.0 }).collect();
        let width = pinhole.width as usize;
        let mut view = Self { pinhole, world_from_camera, inverse_depth: inverse, facing: Vec::new(), color };
        view.facing = (0..view.inverse_depth.len()).into_par_iter().map(|i| view.facing_at(i % width, i / width)).collect();
        view.inverse_depth.iter_mut().zip(&view.facing).for_each(|(inverse, facing)| {
            if *facing == 0.0 {
                *inverse = 0.0;
            }
        });
        view
    }

    /// Memory that it takes.
    pub fn bytes(&self) -> u64 {
        Self::bytes_of(&self.pinhole)
    }

    /// Memory of a view of this camera.
    pub fn bytes_of(pinhole: &Pinhole) -> u64 {
        u64::from(pinhole.width) * u64::from(pinhole.height) * (2 * size_of::<f32>() + size_of::<[u8; 3]>()) as u64
    }

    fn inverse_at(&self, x: isize, y: isize) -> f32 {
        let (width, height) = (self.pinhole.width as isize, self.pinhole.height as isize);
        if (0..width).contains(&x) && (0..height).contains(&y) { self.inverse_depth[(y * width + x) as usize] } else { 0.0 }
    }

    /// Whether inverse depth bends here by more than a surface's does.
    fn is_edge(&self, x: isize, y: isize, here: f32) -> bool {
        let bends = |dx: isize, dy: isize| {
            let (a, b) = (self.inverse_at(x - dx, y - dy), self.inverse_at(x + dx, y + dy));
            a > 0.0 && b > 0.0 && (a + b - 2.0 * here).abs() > 2.0 * EDGE * here
        };
        bends(1, 0) || bends(0, 1) || bends(2, 0) || bends(0, 2)
    }

    /// The cosine at a pixel; 0 at edges, where support lacks, and where the surface is seen from too flat an angle.
    fn facing_at(&self, x: usize, y: usize) -> f32 {
        let (x, y) = (x as isize, y as isize);
        let here = self.inverse_at(x, y);
        if here == 0.0 || self.is_edge(x, y, here) {
            return 0.0;
        }
        let Some((along_x, along_y)) = self.gradient(x, y, here) else { return 0.0 };
        let p = &self.pinhole;
        let ray = Vector3::new((x as f64 - p.cx) / p.fx, (y as f64 - p.cy) / p.fy, 1.0);
        // A plane n·X = 1 has the inverse depth n·ray.
        let (nx, ny) = (along_x * p.fx, along_y * p.fy);
        let normal = Vector3::new(nx, ny, f64::from(here) - nx * ray.x - ny * ray.y);
        let facing = (normal.dot(&ray) / (normal.norm() * ray.norm())) as f32;
        if facing >= LEAST_FACING { facing } else { 0.0 }
    }

    /// Least squares of a plane through the pixel's own surface: change of inverse depth a pixel along x and y.
    fn gradient(&self, x: isize, y: isize, here: f32) -> Option<(f64, f64)> {
        let (mut n, mut sum) = (0usize, [0.0f64; 8]);
        for (dy, dx) in (-WINDOW..=WINDOW).flat_map(|dy| (-WINDOW..=WINDOW).map(move |dx| (dy, dx))) {
            let there = self.inverse_at(x + dx, y + dy);
            let reach = 1.0 + dx.abs().max(dy.abs()) as f32;
            if there == 0.0 || (there - here).abs() > reach * EDGE * here {
                continue;
            }
            let (u, v, w) = (dx as f64, dy as f64, f64::from(there - here));
            n += 1;
            sum.iter_mut().zip([u, v, w, u * u, u * v, v * v, u * w, v * w]).for_each(|(sum, term)| *sum += term);
        }
        if n < LEAST_SUPPORT {
            return None;
        }
        let count = n as f64;
        let [u, v, w, uu, uv, vv, uw, vw] = sum;
        let (uu, uv, vv) = (uu - u * u / count, uv - u * v / count, vv - v * v / count);
        let (uw, vw) = (uw - u * w / count, vw - v * w / count);
        let determinant = uu * vv - uv * uv;
        (determinant > 1e-9).then(|| ((uw * vv - vw * uv) / determinant, (vw * uu - uw * uv) / determinant))
    }

    /// Inverse depth between pixels: bilinear on one surface, else of the nearest pixel; 0 where nothing is known.
    pub(super) fn sample(&self, u: f32, v: f32) -> f32 {
        let (x, y) = (u.floor() as isize, v.floor() as isize);
        let corners =
            [self.inverse_at(x, y), self.inverse_at(x + 1, y), self.inverse_at(x, y + 1), self.inverse_at(x + 1, y + 1)];
        let (low, high) = (corners.iter().copied().fold(f32::MAX, f32::min), corners.iter().copied().fold(0.0, f32::max));
        let (s, t) = (u - x as f32, v - y as f32);
        if low > 0.0 && high - low < 2.0 * EDGE * low {
            let top = corners[0] + s * (corners[1] - corners[0]);
            let bottom = corners[2] + s * (corners[3] - corners[2]);
            return top + t * (bottom - top);
        }
        corners[usize::from(s >= 0.5) + 2 * usize::from(t >= 0.5)]
    }
}
