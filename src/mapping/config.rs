//! What the mapper can be told.

use serde::{Deserialize, Serialize};

use super::{DensityConfig, RefinePosesConfig};
use crate::optimise::{AdamConfig, LossConfig};
use crate::splat::ShDegree;

/// The mapper's configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingConfig {
    /// Degree of the spherical harmonics: 0 has no view dependence.
    pub sh_degree: ShDegree,
    /// Optimisation steps after each keyframe, one view each.
    pub iterations_per_keyframe: usize,
    /// Steps after the first keyframe, which has no map to start from.
    pub first_iterations: usize,
    /// Seed of the draws among keyframes.
    pub seed: u64,
    pub window: WindowConfig,
    pub skip: SkipConfig,
    pub refine_poses: RefinePosesConfig,
    pub seeding: SeedingConfig,
    pub density: DensityConfig,
    pub loss: LossConfig,
    pub adam: AdamConfig,
}

impl Default for MappingConfig {
    fn default() -> Self {
        Self {
            sh_degree: ShDegree::new(1).expect("degrees 0 to 3 exist"),
            iterations_per_keyframe: 50,
            first_iterations: 100,
            seed: 0,
            window: WindowConfig::default(),
            skip: SkipConfig::default(),
            refine_poses: RefinePosesConfig::default(),
            seeding: SeedingConfig::default(),
            density: DensityConfig::default(),
            loss: LossConfig::default(),
            adam: AdamConfig::default(),
        }
    }
}

/// Which keyframes a step may draw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowConfig {
    /// The newest keyframes, always in the window.
    pub recent: usize,
    /// Older keyframes that share most landmarks with the newest one.
    pub covisible: usize,
    /// Share of steps that go to any older keyframe, so that the map does not forget.
    pub older_share: f32,
    /// After each keyframe Adam's step sizes fall evenly to this share of themselves: new Gaussians move fast, and the map has settled
    /// when the next keyframe comes.
    pub last_pace: f32,
}

impl Default for WindowConfig {
    fn default() -> Self {
        Self { recent: 6, covisible: 3, older_share: 0.6, last_pace: 1.0 }
    }
}

/// Work that is left out where little is to be gained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SkipConfig {
    /// Older keyframes are drawn in proportion to their loss, not evenly.
    pub draw_by_loss: bool,
    /// The first steps after a keyframe, this share of them, are taken at half the size.
    pub coarse_share: f32,
    /// The steps after a keyframe end when ten of them lower the loss of their views by less than this share; 0: never.
    pub min_gain: f32,
}

impl Default for SkipConfig {
    fn default() -> Self {
        Self { draw_by_loss: true, coarse_share: 0.0, min_gain: 0.0 }
    }
}

/// Where a keyframe adds Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SeedingConfig {
    /// One seed per `stride`² pixels where the image has detail, and per `flat_stride`² where it is flat.
    pub stride: u32,
    pub flat_stride: u32,
    /// Mean colour gradient (0 to 1, per pixel) of a block above which it has detail.
    pub detail_gradient: f32,
    /// A pixel whose alpha is below this lacks map.
    pub min_alpha: f32,
    /// A pixel whose measured depth is nearer than the map's by this share of itself shows something that the map lacks.
    pub depth_disagreement: f32,
    /// Standard deviation of a seed in units of its spacing on the surface.
    pub footprint: f32,
    /// Standard deviation of a seed across its surface in units of that along it.
    pub thickness: f32,
    /// Opacity of a seed.
    pub opacity: f32,
    /// No seed nearer to the camera or farther than this, metres.
    pub min_depth_metres: f32,
    pub max_depth_metres: f32,
}

impl Default for SeedingConfig {
    fn default() -> Self {
        Self {
            stride: 2,
            flat_stride: 4,
            detail_gradient: 0.02,
            min_alpha: 0.6,
            depth_disagreement: 0.06,
            footprint: 0.55,
            thickness: 1.0,
            opacity: 0.7,
            min_depth_metres: 0.15,
            max_depth_metres: 20.0,
        }
    }
}

impl MappingConfig {
    /// Says what is wrong with the values, if anything.
    pub fn validate(&self) -> Result<(), String> {
        let s = &self.seeding;
        if s.stride == 0 || s.flat_stride < s.stride || !s.flat_stride.is_multiple_of(s.stride) {
            return Err("mapping.seeding.flat_stride must be a multiple of mapping.seeding.stride, both at least 1".into());
        }
        let shares = [
            ("window.older_share", self.window.older_share),
            ("skip.coarse_share", self.skip.coarse_share),
            ("skip.min_gain", self.skip.min_gain),
            ("seeding.min_alpha", s.min_alpha),
            ("seeding.opacity", s.opacity),
        ];
        if let Some((name, value)) = shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            return Err(format!("mapping.{name} must lie between 0 and 1, not {value}"));
        }
        let positive = [
            ("seeding.depth_disagreement", s.depth_disagreement),
            ("seeding.footprint", s.footprint),
            ("seeding.thickness", s.thickness),
            ("seeding.opacity", s.opacity),
            ("seeding.min_depth_metres", s.min_depth_metres),
            ("seeding.max_depth_metres", s.max_depth_metres),
        ];
        if let Some((name, value)) = positive.iter().find(|(_, value)| !(value.is_finite() && *value > 0.0)) {
            return Err(format!("mapping.{name} must be positive, not {value}"));
        }
        if self.window.recent == 0 {
            return Err("mapping.window.recent must be at least 1".into());
        }
        self.refine_poses.validate().map_err(|e| format!("mapping.refine_poses: {e}"))?;
        self.density.validate().map_err(|e| format!("mapping.density: {e}"))?;
        self.loss.validate().map_err(|e| format!("mapping.loss: {e}"))?;
        self.adam.validate().map_err(|e| format!("mapping.adam: {e}"))
    }
}
