//! What a view says of each Gaussian, by its definition; twin of `shaders/shared/tile_scores.wgsl` and `shaders/gather_scores.wgsl`.

use nalgebra::Vector2;

use super::rasterize_backward::backward;
use super::rasterize_forward::{contributions, sorted};
use super::{Gaussian64, ImageGradient64, View64};

/// Scores of one Gaussian in one view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Score64 {
    /// Blending weight over high-error pixels.
    pub error_pixels: f64,
    /// Blending weight over all pixels.
    pub weight_sum: f64,
    /// Largest blending weight.
    pub weight_max: f64,
    /// Normalised device coordinates.
    pub gradient: f64,
    /// Sum of the pixels' absolute gradients, of the loss summed over the pixels, a pixel of motion.
    pub absolute_gradient: f64,
    /// Along z, metres.
    pub depth: f64,
}

/// `[N]` scores in map order; zero where a Gaussian is not blended. `wrong` says which pixels are, `[H * W]`.
pub fn scores(view: &View64, cloud: &[Gaussian64], by_image: &ImageGradient64, wrong: &[bool]) -> Vec<Score64> {
    let sorted = sorted(view, cloud);
    let p = &view.camera.pinhole;
    let mut found = vec![Score64::default(); cloud.len()];
    let mut signed = vec![Vector2::zeros(); cloud.len()];
    let mut absolute = vec![Vector2::<f64>::zeros(); cloud.len()];
    for (x, y) in (0..p.height).flat_map(|y| (0..p.width).map(move |x| (x, y))) {
        let pixel = (y * p.width + x) as usize;
        for c in contributions(view, &sorted, x, y).0 {
            let score = &mut found[sorted[c.index].0];
            let weight = c.alpha * c.transmittance;
            score.error_pixels += f64::from(u8::from(wrong[pixel]));
            score.weight_sum += weight;
            score.weight_max = score.weight_max.max(weight);
            score.depth = sorted[c.index].1.depth;
        }
        // The gradient of this pixel alone.
        let alone = ImageGradient64 {
            color: only(&by_image.color, pixel),
            depth: only(&by_image.depth, pixel),
            alpha: only(&by_image.alpha, pixel),
            surface: only(&by_image.surface, pixel),
        };
        for ((i, _), gradient) in sorted.iter().zip(backward(view, &sorted, &alone)) {
            signed[*i] += gradient.mean;
            absolute[*i] += gradient.mean.abs();
        }
    }
    let half = Vector2::new(f64::from(p.width), f64::from(p.height)) * 0.5;
    let pixels = f64::from(p.width * p.height);
    for (i, score) in found.iter_mut().enumerate() {
        score.gradient = signed[i].component_mul(&half).norm();
        score.absolute_gradient = absolute[i].norm() * pixels;
    }
    found
}

/// Zero but for one place.
fn only<T: Copy + std::ops::Mul<f64, Output = T>>(values: &[T], place: usize) -> Vec<T> {
    values.iter().enumerate().map(|(i, v)| if i == place { *v } else { *v * 0.0 }).collect()
}
