//! Loss of a planar surface beside that of the image; `shaders/surface_loss.wgsl` evaluates it.

use serde::{Deserialize, Serialize};

use crate::render::layout::SurfaceSetup;

/// A pixel that is covered less has no surface.
const LEAST_ALPHA: f32 = 0.5;
/// Neighbouring pixels whose depths differ by more than this share lie on different surfaces.
const EDGE: f32 = 0.05;

/// Weights of a planar surface, used where `mapping.surface` is `planar` (2DGS, Huang et al. 2024; PGSR, Chen et al. 2024). They rise linearly
/// over the final refinement: surfaces that do not exist yet have no normals. Reported losses leave these terms out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlanarConfig {
    /// λ of one minus the cosine between the blended normal and that of the depth around it.
    pub normal_weight: f32,
    /// λ of the variance of depth within a pixel over the square of its mean.
    pub spread_weight: f32,
    /// Share of its second axis to which a Gaussian's shortest shrinks.
    pub thickness: f32,
}

impl Default for PlanarConfig {
    fn default() -> Self {
        Self { normal_weight: 0.01, spread_weight: 2.0, thickness: 0.3 }
    }
}

impl PlanarConfig {
    /// Says what is wrong with the values, if anything.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        if ![self.normal_weight, self.spread_weight].iter().all(|weight| weight.is_finite() && *weight >= 0.0) {
            return Err("normal_weight and spread_weight must be finite and not negative".into());
        }
        if self.thickness > 0.0 && self.thickness <= 1.0 { Ok(()) } else { Err("thickness must lie between 0 and 1".into()) }
    }

    /// The GPU's copy with this factor of each pixel's term.
    pub(super) fn setup(&self, per_pixel: f32) -> SurfaceSetup {
        SurfaceSetup {
            normal_weight: self.normal_weight * per_pixel,
            spread_weight: self.spread_weight * per_pixel,
            min_alpha: LEAST_ALPHA,
            edge: EDGE,
        }
    }
}
