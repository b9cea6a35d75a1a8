//! A rendered view on the host: colour, depth, and the surface of a planar map.

use nalgebra::{Vector2, Vector3};

use crate::geometry::Pinhole;
use crate::splat::Exposure;

/// A rendered view on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendered {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `[H, W]` colour over the background, and Σ w z in metres.
    pub color_depth: Vec<[f32; 4]>,
    /// `[H, W]` share of light that reaches what lies behind the map; alpha is one minus it.
    pub transmittance: Vec<f32>,
    /// `[H, W]` of a planar surface: slopes of the depth along x and y and its square, blended, and the depth behind which less than half of the
    /// light is left; metres and pixels. Empty otherwise.
    pub surface: Vec<[f32; 4]>,
}

impl Rendered {
    /// Share of the pixel `i` that the map covers.
    pub fn alpha(&self, i: usize) -> f32 {
        1.0 - self.transmittance[i]
    }

    /// What lies wholly behind becomes part of the picture.
    pub(super) fn blend_over(&mut self, behind: &Self) {
        for (i, front) in self.surface.iter_mut().enumerate() {
            let (light, [slope_x, slope_y, square, median]) = (self.transmittance[i], behind.surface[i]);
            let is_median = light >= 0.5 && light * behind.transmittance[i] < 0.5;
            let median = if is_median { median } else { front[3] };
            *front = [front[0] + light * slope_x, front[1] + light * slope_y, front[2] + light * square, median];
        }
        let pixels = self.color_depth.iter_mut().zip(&mut self.transmittance);
        for ((front, light), (color_depth, beyond)) in pixels.zip(behind.color_depth.iter().zip(&behind.transmittance)) {
            front.iter_mut().zip(color_depth).for_each(|(front, value)| *front += *light * value);
            *light *= beyond;
        }
    }

    /// Becomes what a camera of this exposure records of it.
    pub fn expose(&mut self, exposure: &Exposure) {
        let [r, g, b] = exposure.gains().to_array();
        self.color_depth.iter_mut().for_each(|p| *p = [p[0] * r, p[1] * g, p[2] * b, p[3]]);
    }

    /// Expected depth of what was blended at pixel `i`, metres; 0 where nothing was.
    pub fn expected_depth(&self, i: usize) -> f32 {
        if self.alpha(i) > 0.0 { self.color_depth[i][3] / self.alpha(i) } else { 0.0 }
    }

    /// Normal of a planar surface at pixel `i` in the camera's frame, towards the camera; `None` where nothing was blended.
    pub fn normal(&self, i: usize, pinhole: &Pinhole) -> Option<Vector3<f64>> {
        let [depth, slope_x, slope_y] = [self.color_depth[i][3], self.surface[i][0], self.surface[i][1]].map(f64::from);
        let (x, y) = (i % self.width as usize, i / self.width as usize);
        let ray = pinhole.unproject(&Vector2::new(x as f64, y as f64), 1.0);
        let across = Vector2::new(pinhole.fx * slope_x, pinhole.fy * slope_y);
        // (-f·g, z + r·f·g) points away from the camera.
        Vector3::new(across.x, across.y, -depth - ray.xy().dot(&across)).try_normalize(0.0)
    }

    /// Depth behind which less than half of the light is left at pixel `i`, metres; 0 where more than that passes. Only of a planar surface.
    pub fn median_depth(&self, i: usize) -> f32 {
        if self.transmittance[i] < 0.5 { self.surface[i][3] } else { 0.0 }
    }
}
