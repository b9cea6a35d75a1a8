//! The oracle: the stages of the rasterizer and the optimiser on the CPU in f64, written for clarity. Finite differences check it
//! (`tests/reference_gradients.rs`), and it checks the GPU (`tests/gpu_against_reference.rs`). Nothing in production imports it; `stress` does, which is a test.

pub mod adam;
pub mod density;
pub mod loss;
pub mod project_backward;
pub mod project_forward;
pub mod rasterize_backward;
pub mod rasterize_forward;
pub mod scores;
pub mod smoothing;
pub mod spherical_harmonics;
pub mod surface;

use nalgebra::{Vector2, Vector3, Vector4};

use crate::splat::model::Surface;
use crate::splat::{GaussianCloud, ShDegree, ViewCamera};

/// One Gaussian's raw parameters; also its gradient, which has the same shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian64 {
    /// Centre in the world, metres.
    pub mean: Vector3<f64>,
    /// Logarithm of the standard deviations, metres.
    pub log_scale: Vector3<f64>,
    /// (w, x, y, z), any length.
    pub rotation: Vector4<f64>,
    /// Logit of the opacity.
    pub raw_opacity: f64,
    /// `[K]` RGB coefficients.
    pub sh: Vec<Vector3<f64>>,
}

impl Gaussian64 {
    /// All parameters zero.
    pub fn zero(sh_degree: ShDegree) -> Self {
        Self {
            mean: Vector3::zeros(),
            log_scale: Vector3::zeros(),
            rotation: Vector4::zeros(),
            raw_opacity: 0.0,
            sh: vec![Vector3::zeros(); sh_degree.coefficients()],
        }
    }

    /// All numbers in one row: mean, log scale, rotation, raw opacity, coefficients.
    pub fn flat(&self) -> Vec<f64> {
        let mut row: Vec<f64> = self.mean.iter().chain(&self.log_scale).chain(&self.rotation).copied().collect();
        row.push(self.raw_opacity);
        row.extend(self.sh.iter().flat_map(|c| c.iter().copied()));
        row
    }

    /// The inverse of [`Self::flat`].
    pub fn from_flat(row: &[f64]) -> Self {
        Self {
            mean: Vector3::from_column_slice(&row[0..3]),
            log_scale: Vector3::from_column_slice(&row[3..6]),
            rotation: Vector4::from_column_slice(&row[6..10]),
            raw_opacity: row[10],
            sh: row[11..].chunks_exact(3).map(Vector3::from_column_slice).collect(),
        }
    }
}

/// The map in f64.
pub fn cloud64(cloud: &GaussianCloud) -> Vec<Gaussian64> {
    let wide = |v: glam::Vec3| Vector3::new(f64::from(v.x), f64::from(v.y), f64::from(v.z));
    (0..cloud.len())
        .map(|i| {
            let g = cloud.get(i);
            let q = g.rotation;
            Gaussian64 {
                mean: wide(g.mean),
                log_scale: wide(g.log_scale),
                rotation: Vector4::new(q.w, q.x, q.y, q.z).map(f64::from),
                raw_opacity: f64::from(g.raw_opacity),
                sh: g.sh.into_iter().map(wide).collect(),
            }
        })
        .collect()
}

/// Whether the discontinuities of the real rasterizer are kept. Finite differences need them gone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cutoffs {
    /// As on the GPU: no contribution under 1/255, and a pixel stops at transmittance 1e-4.
    Sharp,
    /// Gaussians reach everywhere and pixels never stop.
    Smooth,
}

/// A view with its background.
#[derive(Clone, Copy, Debug)]
pub struct View64 {
    /// Camera and pose.
    pub camera: ViewCamera,
    /// Linear RGB behind the map.
    pub background: Vector3<f64>,
    /// Whether the rasterizer's discontinuities are kept.
    pub cutoffs: Cutoffs,
    /// Whether the map is antialiased.
    pub antialiased: bool,
    /// Where along a ray a Gaussian lies.
    pub surface: Surface,
}

/// A rendered image, `[H * W]` each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Image64 {
    /// Linear RGB.
    pub color: Vec<Vector3<f64>>,
    /// Σ w z, metres.
    pub depth: Vec<f64>,
    /// Share of the background, in [0, 1].
    pub transmittance: Vec<f64>,
    /// Of a planar surface, Σ w of the slopes along x and y and of z²; metres, pixels. Zero otherwise.
    pub surface: Vec<Vector3<f64>>,
    /// Depth behind which less than half of the light is left, metres; 0 where more than that passes.
    pub median_depth: Vec<f64>,
}

/// Gradient of a loss by the rendered image.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageGradient64 {
    /// By RGB.
    pub color: Vec<Vector3<f64>>,
    /// By Σ w z.
    pub depth: Vec<f64>,
    /// By alpha = 1 - transmittance.
    pub alpha: Vec<f64>,
    /// By a planar surface's slopes and z².
    pub surface: Vec<Vector3<f64>>,
}

impl ImageGradient64 {
    /// None, of so many pixels.
    pub fn zero(pixels: usize) -> Self {
        let (color, surface) = (vec![Vector3::zeros(); pixels], vec![Vector3::zeros(); pixels]);
        Self { color, depth: vec![0.0; pixels], alpha: vec![0.0; pixels], surface }
    }

    /// The sum of two losses' gradients.
    pub fn plus(mut self, other: &Self) -> Self {
        let add = |to: &mut [Vector3<f64>], from: &[Vector3<f64>]| to.iter_mut().zip(from).for_each(|(a, b)| *a += b);
        let add_scalars = |to: &mut [f64], from: &[f64]| to.iter_mut().zip(from).for_each(|(a, b)| *a += b);
        add(&mut self.color, &other.color);
        add(&mut self.surface, &other.surface);
        add_scalars(&mut self.depth, &other.depth);
        add_scalars(&mut self.alpha, &other.alpha);
        self
    }
}

/// Gradient of a loss by what the projection made of one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProjectedGradient {
    /// By the projected centre, pixels.
    pub mean: Vector2<f64>,
    /// By the conic's xx, xy, yy; xy counts once for both of its places.
    pub conic: Vector3<f64>,
    /// By the opacity.
    pub opacity: f64,
    /// By RGB.
    pub color: Vector3<f64>,
    /// By the depth along z.
    pub depth: f64,
    /// By the slope of the depth.
    pub slope: Vector2<f64>,
}
