//! Mapper configuration.

use serde::{Deserialize, Serialize};

use super::{DensityConfig, ExposureConfig, LimitsConfig, MultiViewConfig, PlaneSweepConfig};
use crate::optimise::{AdamConfig, LossConfig, PlanarConfig};
use crate::splat::ShDegree;
use crate::splat::model::Surface;

/// The mapper's configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingConfig {
    /// Degree of the spherical harmonics: 0 has no view dependence.
    pub sh_degree: ShDegree,
    /// Whether the map has Mip-Splatting's filters, for views from much nearer or farther than the keyframes.
    pub antialiased: bool,
    /// `volume`, or `planar` for surfaces: flat Gaussians, depth where rays meet their planes, and normals that agree with it.
    pub surface: Surface,
    /// Weights of a planar surface.
    pub planar: PlanarConfig,
    /// Optimisation steps over the window after each keyframe, one view each. Most steps gain more in consolidation.
    pub iterations_per_keyframe: usize,
    /// Steps after the first keyframe, which has no map to start from.
    pub first_iterations: usize,
    /// Whether the steps after a keyframe end as soon as the next one waits, or none will come: as many as there is time for. Such a run
    /// does not repeat.
    pub yields_to_keyframes: bool,
    /// Seed of the draws among keyframes.
    pub seed: u64,
    /// Keyframes that the steps over the window learn from.
    pub window: WindowConfig,
    /// Bounds on Gaussians, memory and keyframes.
    pub limits: LimitsConfig,
    /// Correction of exposure and white balance.
    pub exposure: ExposureConfig,
    /// Insertion of Gaussians at a keyframe.
    pub insertion: InsertionConfig,
    /// Depth estimation for cameras without a depth sensor.
    pub plane_sweep: PlaneSweepConfig,
    /// Gaussians from the recording's points.
    pub points: PointsConfig,
    /// Refinement over all keyframes after the last one.
    pub refine: RefineConfig,
    /// Densification and pruning.
    pub density: DensityConfig,
    /// Image loss.
    pub loss: LossConfig,
    /// Learning rates and decay rates.
    pub adam: AdamConfig,
}

impl Default for MappingConfig {
    fn default() -> Self {
        Self {
            sh_degree: ShDegree::new(3).expect("degrees 0 to 3 exist"),
            antialiased: false,
            surface: Surface::default(),
            planar: PlanarConfig::default(),
            iterations_per_keyframe: 4,
            first_iterations: 20,
            yields_to_keyframes: false,
            seed: 0,
            window: WindowConfig::default(),
            limits: LimitsConfig::default(),
            exposure: ExposureConfig::default(),
            insertion: InsertionConfig::default(),
            plane_sweep: PlaneSweepConfig::default(),
            points: PointsConfig::default(),
            refine: RefineConfig::default(),
            density: DensityConfig::default(),
            loss: LossConfig::default(),
            adam: AdamConfig::default(),
        }
    }
}

/// The keyframes that the steps over the window learn from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowConfig {
    /// The newest keyframes, always in the window.
    pub recent: usize,
    /// Older keyframes that share most landmarks with the newest one.
    pub covisible: usize,
}

impl Default for WindowConfig {
    fn default() -> Self {
        Self { recent: 6, covisible: 3 }
    }
}

/// Where a keyframe adds Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InsertionConfig {
    /// One Gaussian per `stride`² pixels where the image has most detail, and per `flat_stride`² where it is flat.
    pub stride: u32,
    /// Side of the largest blocks, pixels.
    pub flat_stride: u32,
    /// Standard deviation of a block's colours (0 to 1) above which the block is quartered.
    pub detail: f32,
    /// A pixel whose alpha is below this lacks map.
    pub min_alpha: f32,
    /// A pixel whose measured depth is nearer than the map's by this share of itself shows something that the map lacks.
    pub depth_disagreement: f32,
    /// A block whose brightness differs from its surroundings by this much more in the image than in the render, or less, misses detail;
    /// 0 to 1, 1: none does.
    pub missed_detail: f32,
    /// Standard deviation of a new Gaussian in units of its spacing on the surface.
    pub footprint: f32,
    /// Standard deviation of a new Gaussian across its surface in units of that along it.
    pub thickness: f32,
    /// Opacity of a new Gaussian.
    pub opacity: f32,
    /// No Gaussian is inserted nearer to the camera or farther than this, metres.
    pub min_depth_metres: f32,
    /// Largest distance of an inserted Gaussian, metres.
    pub max_depth_metres: f32,
}

impl Default for InsertionConfig {
    fn default() -> Self {
        Self {
            stride: 2,
            flat_stride: 4,
            detail: 0.05,
            min_alpha: 0.6,
            depth_disagreement: 0.06,
            missed_detail: 0.08,
            footprint: 0.55,
            thickness: 1.0,
            opacity: 0.7,
            min_depth_metres: 0.15,
            max_depth_metres: 200.0,
        }
    }
}

/// How points of the scene that came with the recording become Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PointsConfig {
    /// Least spacing of the points, about so many pixels of the nearest view (at the mapping resolution).
    pub spacing_pixels: f32,
    /// Standard deviation in units of the mean distance to the three nearest points.
    pub footprint: f32,
    /// Initial opacity, 0 to 1.
    pub opacity: f32,
    /// No Gaussian is this many times smaller or larger than the median one.
    pub size_range: f32,
}

impl Default for PointsConfig {
    fn default() -> Self {
        Self { spacing_pixels: 5.6, footprint: 1.0, opacity: 0.3, size_range: 8.0 }
    }
}

/// Consolidation: steps over all keyframes with images, online and, in seeded, shuffled epochs, after the last keyframe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefineConfig {
    /// Steps over all keyframes that follow each keyframe, most over those that had few.
    pub steps_per_keyframe: usize,
    /// Steps after the last keyframe, for each keyframe that is not image-only. They draw from all, in shuffled epochs.
    pub final_epochs: usize,
    /// Least steps after the last keyframe, one view each, whatever the number of keyframes. Without steps and epochs the map stays as it is.
    pub steps: usize,
    /// Wall-clock time after the last keyframe, seconds: replaces the number of steps. Such a run does not repeat.
    // Checkpoints hold this struct in postcard, where no field may be left out.
    pub seconds: Option<f64>,
    /// Density is controlled each time after so many steps (in real time, at the next keyframe),
    pub density_every: usize,
    /// by the scores of so many keyframes, evenly spread over all.
    pub density_views: usize,
    /// Share of the steps after which the map grows no more.
    pub growth_share: f32,
    /// Share of the steps, the first ones, that see the images at half size.
    pub half_size_share: f32,
    /// Learning rate of positions at the end of the refinement, as a share of the initial one.
    pub final_lr_scale_position: f32,
    /// Factor on all other learning rates at the end of the refinement.
    pub final_lr_scale: f32,
    /// Share of the Gaussians that the last step leaves out, for scenes that few views see; it grows linearly from zero.
    pub dropout: f32,
}

impl RefineConfig {
    /// Checks every value but the shares and rates.
    fn validate(&self) -> Result<(), String> {
        if self.seconds.is_some_and(|seconds| !(seconds.is_finite() && seconds >= 0.0)) {
            return Err("seconds must be zero or more".into());
        }
        if self.density_every == 0 || self.density_views == 0 {
            return Err("density_every and density_views must be at least 1".into());
        }
        Ok(())
    }
}

impl Default for RefineConfig {
    fn default() -> Self {
        Self {
            steps_per_keyframe: 13,
            final_epochs: 6,
            steps: 0,
            seconds: None,
            density_every: 200,
            density_views: 10,
            growth_share: 0.65,
            half_size_share: 0.0,
            final_lr_scale_position: 0.1,
            final_lr_scale: 0.2,
            dropout: 0.0,
        }
    }
}

impl MappingConfig {
    /// For recordings whose poses are known: keyframes only arrive, and the refinement makes the map.
    pub fn offline() -> Self {
        let refine =
            RefineConfig { steps_per_keyframe: 0, final_epochs: 0, steps: 6000, half_size_share: 0.3, ..RefineConfig::default() };
        // Thousands of steps need lower rates, except for positions: points and inserted Gaussians lie further from where they belong than those
        // of a depth image do. The rates fall by themselves, which leaves averages nothing but to lag behind. Second
        // moments remember a hundred steps.
        let rates = AdamConfig { lr_position: 0.24, ..AdamConfig::default() }.scaled(2.0 / 3.0, 2.0 / 3.0);
        let adam = AdamConfig { color_settling_steps: 0.0, ema_steps: 1.0, beta_2: 0.99, ..rates };
        // No keyframe inserts anything during the refinement: what the first Gaussians miss must grow out of them, and only steep ones divide.
        let mut density = DensityConfig::default();
        let MultiViewConfig { max_growth, pixel_gradient, min_contribution, .. } = &mut density.multi_view;
        (*max_growth, *pixel_gradient, *min_contribution) = (0.15, 1.25, 0.5);
        // Photos arrive before there is a map to compare them with.
        let exposure = ExposureConfig { refinements: 3, ..ExposureConfig::default() };
        // The degree with which the other settings were chosen.
        let sh_degree = ShDegree::new(2).expect("degrees 0 to 3 exist");
        Self { sh_degree, iterations_per_keyframe: 0, first_iterations: 0, exposure, refine, adam, density, ..Self::default() }
    }

    /// A copy for a world of `units_per_metre` units to a metre: every length is converted.
    pub fn in_units(&self, units_per_metre: f32) -> Self {
        let mut scaled = self.clone();
        let lengths = [
            &mut scaled.density.max_scale_metres,
            &mut scaled.insertion.min_depth_metres,
            &mut scaled.insertion.max_depth_metres,
            &mut scaled.loss.precise_depth_metres,
        ];
        lengths.into_iter().for_each(|length| *length *= units_per_metre);
        scaled.loss.depth_weight /= units_per_metre;
        scaled
    }

    /// Whether any step may be taken at half the size.
    pub fn learns_at_half_size(&self) -> bool {
        let RefineConfig { steps, final_epochs, seconds, half_size_share, .. } = self.refine;
        (steps.max(final_epochs) > 0 || seconds.is_some()) && half_size_share > 0.0
    }

    /// Whether the clock decides on the number of steps. Such a run neither repeats nor resumes.
    pub fn depends_on_time(&self) -> bool {
        self.yields_to_keyframes || self.refine.seconds.is_some()
    }

    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        let s = &self.insertion;
        if !(s.stride.is_power_of_two() && s.flat_stride.is_power_of_two() && s.stride <= s.flat_stride && s.flat_stride <= 64) {
            return Err(
                "mapping.insertion.stride and flat_stride must be powers of two up to 64, flat_stride the larger one".into()
            );
        }
        let shares = [
            ("insertion.min_alpha", s.min_alpha),
            ("insertion.opacity", s.opacity),
            ("insertion.detail", s.detail),
            ("points.opacity", self.points.opacity),
            ("refine.dropout", self.refine.dropout),
        ];
        if let Some((name, value)) = shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            return Err(format!("mapping.{name} must lie between 0 and 1, not {value}"));
        }
        let positive = [
            ("points.opacity", self.points.opacity),
            ("points.spacing_pixels", self.points.spacing_pixels),
            ("points.footprint", self.points.footprint),
            ("refine.final_lr_scale_position", self.refine.final_lr_scale_position),
            ("refine.final_lr_scale", self.refine.final_lr_scale),
            ("insertion.depth_disagreement", s.depth_disagreement),
            ("insertion.missed_detail", s.missed_detail),
            ("insertion.footprint", s.footprint),
            ("insertion.thickness", s.thickness),
            ("insertion.opacity", s.opacity),
            ("insertion.min_depth_metres", s.min_depth_metres),
            ("insertion.max_depth_metres", s.max_depth_metres),
        ];
        if let Some((name, value)) = positive.iter().find(|(_, value)| !(value.is_finite() && *value > 0.0)) {
            return Err(format!("mapping.{name} must be positive, not {value}"));
        }
        if self.window.recent == 0 || !(self.points.size_range.is_finite() && self.points.size_range >= 1.0) {
            return Err("mapping.window.recent and mapping.points.size_range must be at least 1".into());
        }
        self.limits.validate().map_err(|e| format!("mapping.limits: {e}"))?;
        let closed_shares =
            [("refine.growth_share", self.refine.growth_share), ("refine.half_size_share", self.refine.half_size_share)];
        if let Some((name, value)) = closed_shares.iter().find(|(_, value)| !(0.0..=1.0).contains(value)) {
            return Err(format!("mapping.{name} must lie between 0 and 1, not {value}"));
        }
        self.refine.validate().map_err(|e| format!("mapping.refine: {e}"))?;
        self.exposure.validate().map_err(|e| format!("mapping.exposure: {e}"))?;
        self.plane_sweep.validate().map_err(|e| format!("mapping.plane_sweep: {e}"))?;
        self.density.validate().map_err(|e| format!("mapping.density: {e}"))?;
        self.planar.validate().map_err(|e| format!("mapping.planar: {e}"))?;
        self.loss.validate().map_err(|e| format!("mapping.loss: {e}"))?;
        self.adam.validate().map_err(|e| format!("mapping.adam: {e}"))
    }
}
