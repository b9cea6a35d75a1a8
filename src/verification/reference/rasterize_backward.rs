//! Gradient of the blended image by what was blended; twin of `shaders/rasterize_backward.wgsl`, but back to front with suffix sums.

use nalgebra::Vector3;

use super::project_forward::Projected64;
use super::rasterize_forward::contributions;
use super::{ImageGradient64, ProjectedGradient, View64};
use crate::splat::model::Surface;

/// `[sorted.len()]` gradients by the projected Gaussians.
pub fn backward(view: &View64, sorted: &[(usize, Projected64)], by_image: &ImageGradient64) -> Vec<ProjectedGradient> {
    let p = &view.camera.pinhole;
    let mut gradients = vec![ProjectedGradient::default(); sorted.len()];
    for (x, y) in (0..p.height).flat_map(|y| (0..p.width).map(move |x| (x, y))) {
        let pixel = (y * p.width + x) as usize;
        let (by_color, by_depth, by_surface) = (by_image.color[pixel], by_image.depth[pixel], by_image.surface[pixel]);
        let is_planar = view.surface == Surface::Planar;
        let (found, last) = contributions(view, sorted, x, y);
        // The value of everything behind the current Gaussian, as seen from just behind it (divided by its transmittance).
        let mut behind = view.background.dot(&by_color) - by_image.alpha[pixel];
        debug_assert!(last <= 1.0);
        for c in found.iter().rev() {
            let g = &sorted[c.index].1;
            let depth = g.depth_at(&c.offset);
            let surface = if is_planar { Vector3::new(g.slope.x, g.slope.y, depth * depth) } else { Vector3::zeros() };
            let own = g.color.dot(&by_color) + depth * by_depth + surface.dot(&by_surface);
            let weight = c.alpha * c.transmittance;
            let by_depth = by_depth + if is_planar { 2.0 * depth * by_surface.z } else { 0.0 };
            let out = &mut gradients[c.index];
            out.color += by_color * weight;
            out.depth += by_depth * weight;
            if is_planar {
                out.slope += (c.offset * by_depth + by_surface.xy()) * weight;
                out.mean -= g.slope * by_depth * weight;
            }
            let by_alpha = c.transmittance * (own - behind);
            behind = c.alpha * own + (1.0 - c.alpha) * behind;
            if c.capped {
                continue;
            }
            let by_power = by_alpha * c.alpha;
            out.opacity += by_power / g.opacity;
            out.mean += g.conic * c.offset * by_power;
            let d = c.offset;
            out.conic += Vector3::new(-0.5 * d.x * d.x, -d.x * d.y, -0.5 * d.y * d.y) * by_power;
        }
    }
    gradients
}
