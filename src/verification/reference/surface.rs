//! The plane that stands for a Gaussian, and the loss of a planar surface; twin of parts of `shaders/shared/projection.wgsl`, `project_backward.wgsl` and of
//! `shaders/surface_loss.wgsl`, in matrices.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::{Image64, ImageGradient64};
use crate::geometry::Pinhole;
use crate::splat::model;

/// A Gaussian's plane (RaDe-GS, Zhang et al. 2024): along the ray r its density is largest at z(r) = (rᵀΛp)/(rᵀΛr), whose derivative by r at the mean is
/// -z·Λp/(rᵀΛp).
#[derive(Clone, Debug)]
pub(super) struct Plane64 {
    /// Axes in the camera frame over their standard deviations, B: the inverse covariance is Λ = B·Bᵀ.
    sharpness: Matrix3<f64>,
    /// The mean in the camera frame.
    mean: Vector3<f64>,
    /// Change of depth by the ray over the depth.
    pub slant: Vector2<f64>,
    /// 1 where it is within its bounds, else 0.
    inside: Vector2<f64>,
}

/// By the mean in the camera frame, and by the scaled axes.
pub(super) struct ByPlane {
    pub mean: Vector3<f64>,
    pub axes: Matrix3<f64>,
}

impl Plane64 {
    /// Of a Gaussian with the scaled axes in the camera frame.
    pub fn new(axes: &Matrix3<f64>, mean: Vector3<f64>) -> Self {
        let mut sharpness = *axes;
        sharpness.column_iter_mut().for_each(|mut axis| axis /= axis.norm_squared());
        let normal = sharpness * (sharpness.transpose() * mean);
        let slant = -normal.xy() * mean.z / normal.dot(&mean);
        let bounded = slant.map(|s| s.clamp(-model::MOST_SLANT, model::MOST_SLANT));
        let inside = slant.zip_map(&bounded, |a, b| if a == b { 1.0 } else { 0.0 });
        Self { sharpness, mean, slant: bounded, inside }
    }

    /// From the gradient by the slant.
    pub fn backward(&self, by_slant: Vector2<f64>) -> ByPlane {
        let by = by_slant.component_mul(&self.inside);
        let (b, p) = (&self.sharpness, self.mean);
        let normal = b * (b.transpose() * p);
        let product = normal.dot(&p);
        // slant = -n_xy·z / (n·p)
        let by_product = -by.dot(&self.slant) / product;
        let by_normal = Vector3::new(-by.x, -by.y, 0.0) * (p.z / product) + p * by_product;
        let by_z = -by.dot(&normal.xy()) / product;
        let mean = b * (b.transpose() * by_normal) + normal * by_product + Vector3::new(0.0, 0.0, by_z);
        // n = Λp, and with the scaled axes M, Λ = (M·Mᵀ)⁻¹: dΛ = -Λ·d(M·Mᵀ)·Λ, and Λ·M = B.
        let outer = (b.transpose() * by_normal) * (b.transpose() * p).transpose();
        ByPlane { mean, axes: -b * (outer + outer.transpose()) }
    }
}

/// Weights of the loss of a planar surface.
#[derive(Clone, Copy, Debug)]
pub struct SurfaceWeights {
    /// Of one minus the cosine of the normals.
    pub normal: f64,
    /// Of the depths' variance over their squared mean.
    pub spread: f64,
    /// Alpha below which there is no surface.
    pub min_alpha: f64,
    /// Share of the depth by which neighbours on one surface may differ.
    pub edge: f64,
}

/// The normal (-f·g, z + r·f·g) of a pixel's plane of depth z and slope g.
fn normal(p: &Pinhole, pixel: (usize, usize), slope: Vector2<f64>, depth: f64) -> Vector3<f64> {
    let ray = p.unproject(&Vector2::new(pixel.0 as f64, pixel.1 as f64), 1.0);
    let scaled = Vector2::new(p.fx, p.fy).component_mul(&slope);
    Vector3::new(-scaled.x, -scaled.y, depth + ray.xy().dot(&scaled))
}

/// Its transpose: by the slope and by the depth.
fn normal_backward(p: &Pinhole, pixel: (usize, usize), by: Vector3<f64>) -> (Vector2<f64>, f64) {
    let ray = p.unproject(&Vector2::new(pixel.0 as f64, pixel.1 as f64), 1.0);
    (Vector2::new(p.fx * (by.z * ray.x - by.x), p.fy * (by.z * ray.y - by.y)), by.z)
}

/// The loss and its gradient by the rendered image.
pub fn loss(p: &Pinhole, image: &Image64, weights: &SurfaceWeights) -> (f64, ImageGradient64) {
    let (width, height) = (p.width as usize, p.height as usize);
    let pixels = width * height;
    let per_pixel = 1.0 / pixels as f64;
    let alpha = |i: usize| 1.0 - image.transmittance[i];
    let depth = |i: usize| if alpha(i) >= weights.min_alpha { image.depth[i].max(0.0) / alpha(i) } else { 0.0 };
    let mut by = ImageGradient64::zero(pixels);
    let mut by_depth = vec![0.0; pixels];
    let mut value = 0.0;
    for (x, y) in (1..height.max(2) - 1).flat_map(|y| (1..width.max(2) - 1).map(move |x| (x, y))) {
        let i = y * width + x;
        let sides = [i - 1, i + 1, i - width, i + width];
        if depth(i) == 0.0 || sides.iter().any(|side| (depth(*side) - depth(i)).abs() >= weights.edge * depth(i)) {
            continue;
        }
        let [left, right, above, below] = sides.map(depth);
        let blended = normal(p, (x, y), image.surface[i].xy(), image.depth[i]);
        let of_depths = normal(p, (x, y), Vector2::new(right - left, below - above) * 0.5, depth(i));
        let (a, b) = (blended.normalize(), of_depths.normalize());
        let (cosine, weight) = (a.dot(&b), weights.normal * per_pixel);
        value += weight * (1.0 - cosine);
        let (by_slope, by_sum) = normal_backward(p, (x, y), -weight * (b - cosine * a) / blended.norm());
        by.surface[i] += Vector3::new(by_slope.x, by_slope.y, 0.0);
        by.depth[i] += by_sum;
        let (by_slope, by_own) = normal_backward(p, (x, y), -weight * (a - cosine * b) / of_depths.norm());
        by_depth[i] += by_own;
        for (side, sign) in sides.into_iter().zip([
            Vector2::new(-0.5, 0.0),
            Vector2::new(0.5, 0.0),
            Vector2::new(0.0, -0.5),
            Vector2::new(0.0, 0.5),
        ]) {
            by_depth[side] += sign.dot(&by_slope);
        }
    }
    for i in (0..pixels).filter(|&i| depth(i) > 0.0) {
        by.depth[i] += by_depth[i] / alpha(i);
        by.alpha[i] -= by_depth[i] * depth(i) / alpha(i);
        let (sum, squares, weight) = (image.depth[i], image.surface[i].z, weights.spread * per_pixel);
        value += weight * (squares * alpha(i) / (sum * sum) - 1.0);
        by.surface[i].z += weight * alpha(i) / (sum * sum);
        by.alpha[i] += weight * squares / (sum * sum);
        by.depth[i] -= 2.0 * weight * squares * alpha(i) / (sum * sum * sum);
    }
    (value, by)
}
