//! L1 + SSIM + depth loss of a rendered view and its gradient; twin of `shaders/loss_forward.wgsl` and `loss_backward.wgsl`.

use nalgebra::Vector3;

use super::{Image64, ImageGradient64};

/// Recorded colour and depth of a view.
#[derive(Clone, Debug)]
pub struct Target64 {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// `[H * W]` in [0, 1].
    pub color: Vec<Vector3<f64>>,
    /// `[H * W]` metres, 0 where not measured.
    pub depth: Vec<f64>,
    /// `[H * W]` whether the camera recorded the pixel.
    pub valid: Vec<bool>,
}

/// Weights of the loss: λ of SSIM against L1, and of the depth term per metre.
#[derive(Clone, Copy, Debug)]
pub struct LossWeights {
    /// λ of SSIM against L1, in [0, 1].
    pub ssim: f64,
    /// Weight of the depth term, 1/metres.
    pub depth: f64,
    /// Depth beyond which its weight falls with the square, metres.
    pub precise_depth: f64,
    /// First pixel with a window of SSIM along x and y: windows lie at every second pixel of every second row.
    pub phase: [usize; 2],
}

const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
const RADIUS: isize = 5;

/// SSIM's window: a Gaussian of σ = 1.5 over 11 taps, normalised.
fn window() -> Vec<f64> {
    let taps: Vec<f64> = (-RADIUS..=RADIUS).map(|d| (-(d * d) as f64 / (2.0 * 1.5 * 1.5)).exp()).collect();
    let sum: f64 = taps.iter().sum();
    taps.iter().map(|t| t / sum).collect()
}

/// Two-dimensional window filter with zeros beyond the image.
fn blur(width: usize, height: usize, values: &[f64]) -> Vec<f64> {
    let taps = window();
    let along = |values: &[f64], step: (isize, isize)| -> Vec<f64> {
        (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as isize, (i / width) as isize);
                (-RADIUS..=RADIUS)
                    .map(|d| {
                        let (u, v) = (x + d * step.0, y + d * step.1);
                        let inside = u >= 0 && v >= 0 && u < width as isize && v < height as isize;
                        if inside { taps[(d + RADIUS) as usize] * values[v as usize * width + u as usize] } else { 0.0 }
                    })
                    .sum()
            })
            .collect()
    };
    along(&along(values, (1, 0)), (0, 1))
}

/// The loss and its gradient by the rendered image.
pub fn loss(image: &Image64, target: &Target64, weights: &LossWeights) -> (f64, ImageGradient64) {
    let pixels = target.width * target.height;
    let per_pixel = 1.0 / pixels as f64;
    let mut value = 0.0;
    let mut gradient = ImageGradient64::zero(pixels);
    for channel in 0..3 {
        // Pixels that were not recorded are zero in both images, as those beyond the border are.
        let recorded = |colors: &[Vector3<f64>]| -> Vec<f64> {
            colors.iter().zip(&target.valid).map(|(color, valid)| if *valid { color[channel] } else { 0.0 }).collect()
        };
        let (x, y) = (recorded(&image.color), recorded(&target.color));
        let (ssim, by_x) = mean_ssim(target, &x, &y, weights.phase);
        value += weights.ssim * (1.0 - ssim) / 3.0;
        for i in (0..pixels).filter(|&i| target.valid[i]) {
            value += (1.0 - weights.ssim) * (x[i] - y[i]).abs() * per_pixel / 3.0;
            let sign = if x[i] == y[i] { 0.0 } else { (x[i] - y[i]).signum() };
            gradient.color[i][channel] = ((1.0 - weights.ssim) * sign - weights.ssim * by_x[i] * pixels as f64) * per_pixel / 3.0;
        }
    }
    for i in (0..pixels).filter(|&i| target.valid[i] && target.depth[i] > 0.0) {
        let residual = image.depth[i] - (1.0 - image.transmittance[i]) * target.depth[i];
        let weight = weights.depth * (weights.precise_depth / target.depth[i]).powi(2).min(1.0) * per_pixel;
        value += weight * residual.abs();
        let side = if residual == 0.0 { 0.0 } else { residual.signum() } * weight;
        gradient.depth[i] = side;
        gradient.alpha[i] = -side * target.depth[i];
    }
    (value, gradient)
}

/// Mean SSIM of the windows of a phase, and its gradient by `x`. A window at a pixel that was not recorded is perfect.
fn mean_ssim(target: &Target64, x: &[f64], y: &[f64], phase: [usize; 2]) -> (f64, Vec<f64>) {
    let Target64 { width, height, .. } = *target;
    let product = |a: &[f64], b: &[f64]| -> Vec<f64> { a.iter().zip(b).map(|(a, b)| a * b).collect() };
    let filter = |values: &[f64]| blur(width, height, values);
    let (mx, my) = (filter(x), filter(y));
    let (xx, yy, xy) = (filter(&product(x, x)), filter(&product(y, y)), filter(&product(x, y)));
    let is_window = |i: &usize| i % width % 2 == phase[0] && i / width % 2 == phase[1];
    let per_window = 1.0 / (0..x.len()).filter(is_window).count().max(1) as f64;
    let mut mean = 0.0;
    let mut partials = [vec![0.0; x.len()], vec![0.0; x.len()], vec![0.0; x.len()]];
    for i in (0..x.len()).filter(is_window) {
        if !target.valid[i] {
            mean += per_window;
            continue;
        }
        let a1 = 2.0 * mx[i] * my[i] + C1;
        let a2 = 2.0 * (xy[i] - mx[i] * my[i]) + C2;
        let b1 = mx[i] * mx[i] + my[i] * my[i] + C1;
        let raw = xx[i] + yy[i] - mx[i] * mx[i] - my[i] * my[i];
        let b2 = raw.max(0.0) + C2;
        let value = a1 * a2 / (b1 * b2);
        mean += value * per_window;
        // log-derivatives of the four factors, by the mean, the mean square and the mean product.
        let free = if raw > 0.0 { 1.0 } else { 0.0 };
        partials[1][i] = -value / b2 * free;
        partials[2][i] = 2.0 * value / a2;
        if a2 == 0.0 {
            partials[2][i] = 2.0 * a1 / (b1 * b2);
        }
        partials[0][i] =
            2.0 * my[i] * a2 / (b1 * b2) - 2.0 * mx[i] * value / b1 - 2.0 * mx[i] * partials[1][i] - my[i] * partials[2][i];
    }
    let [by_mean, by_square, by_product] = partials.map(|p| filter(&p));
    let by_x = (0..x.len()).map(|i| per_window * (by_mean[i] + 2.0 * x[i] * by_square[i] + y[i] * by_product[i])).collect();
    (mean, by_x)
}
