//! What rendering a Gaussian means: the constants of the splatting model and the camera of a view, shared by the rasterizer and its
//! oracle.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{Pinhole, Se3};

/// Alpha below which a Gaussian does not touch a pixel: half a step of an 8-bit image, as in 3DGS.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;
/// Alpha never exceeds this, so that 1 - α stays invertible.
pub const ALPHA_MAX: f64 = 0.99;
/// A pixel is finished before its transmittance would fall below this.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;
/// Gaussians nearer than this (their projection blows up) or farther than that are not drawn, metres.
pub const NEAR_METRES: f64 = 0.05;
/// Largest depth of a drawn Gaussian, metres.
pub const FAR_METRES: f64 = 1e5;
/// Added to the image covariance's diagonal, pixels²: the footprint of a pixel (3DGS).
pub const DILATION: f64 = 0.3;
/// The same of an antialiased map: its smoothing takes the place of the rest (Mip-Splatting).
pub const ANTIALIASED_DILATION: f64 = 0.1;
/// Standard deviation of the smoothing of an antialiased map in sampling intervals. Mip-Splatting's √0.2 costs 0.1 to 0.5 dB at the keyframes'
/// own scale, and gains nothing at others.
pub const SMOOTHING: f64 = 0.3;
/// Least square of the factor by which an antialiased map's opacities shrink in the image.
pub const LEAST_UNDILUTED: f64 = 2.5e-5;
/// Least determinant of an image covariance, pixels⁴.
pub const MIN_DETERMINANT: f64 = 1e-6;
/// Least squared norm of a rotation.
pub const MIN_QUATERNION_NORM_SQUARED: f64 = 1e-8;
/// How far beyond the image's edge, as a share of its size, the Jacobian follows x/z and y/z.
pub const TANGENT_MARGIN: f64 = 0.15;

/// Bits of a depth, as f32, that one step of [`depth_key`] spans.
pub const DEPTH_KEY_STEP: u32 = ((FAR_METRES as f32).to_bits() - (NEAR_METRES as f32).to_bits()).div_ceil(1 << 16);

/// Sixteen bits by which Gaussians are sorted, of a depth between [`NEAR_METRES`] and [`FAR_METRES`]: the bits of positive floats grow with
/// them. Equal keys keep the order of the map; their depths differ by less than 1 in 3,000.
pub fn depth_key(depth: f32) -> u32 {
    (depth.to_bits() - (NEAR_METRES as f32).to_bits()) / DEPTH_KEY_STEP
}

/// Gaussians that a training step leaves out, so that none relies on others that few views see (DropGaussian, Park et al. 2025). The opacities
/// of the others grow by 1 / (1 - share).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Dropout {
    /// Share of the Gaussians that is left out, below 1.
    pub share: f32,
    /// Equal seeds leave out the same places of a map.
    pub seed: u32,
}

/// Where along a ray a Gaussian lies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Surface {
    /// At the depth of its centre.
    #[default]
    Volume,
    /// Where the ray meets its plane: the normal is that of its level set (RaDe-GS), its thinnest axis where it is flat.
    Planar,
}

/// Most that depth changes along a plane, in units of what the ray moves sideways: beyond, the plane is seen edge on.
pub const MOST_SLANT: f64 = 4.0;

/// A camera to render from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewCamera {
    /// Intrinsics.
    pub pinhole: Pinhole,
    /// Pose.
    pub camera_from_world: Se3,
}

impl ViewCamera {
    /// Pose in single precision: rows of the rotation, and the translation in metres.
    pub fn rows(&self) -> ([Vec3; 3], [f32; 3]) {
        let rotation = self.camera_from_world.rotation.to_rotation_matrix();
        let row = |r: usize| Vec3::new(rotation[(r, 0)] as f32, rotation[(r, 1)] as f32, rotation[(r, 2)] as f32);
        ([row(0), row(1), row(2)], self.camera_from_world.translation.vector.map(|v| v as f32).into())
    }
}

/// The bounds min x, max x, min y, max y on x/z and y/z inside the projection's Jacobian.
pub fn tangent_bounds(p: &Pinhole) -> [f64; 4] {
    let (w, h) = (f64::from(p.width), f64::from(p.height));
    let (mx, my) = (TANGENT_MARGIN * w, TANGENT_MARGIN * h);
    [(-mx - p.cx) / p.fx, (w + mx - p.cx) / p.fx, (-my - p.cy) / p.fy, (h + my - p.cy) / p.fy]
}
