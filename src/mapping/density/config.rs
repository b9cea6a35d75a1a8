//! Configuration of density control.

use serde::{Deserialize, Serialize};

use crate::optimise::ErrorPixels;
use crate::render::layout::DensitySetup;
use crate::splat::raw_opacity_from_opacity;

/// Views that must have shown a Gaussian before it can be called useless.
const MIN_VIEWS: f32 = 3.0;

/// How the map's density is controlled after each keyframe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DensityStrategy {
    /// Multi-view-consistent densification and pruning (FastGS, arXiv 2511.04283), over the keyframe window.
    #[default]
    MultiView,
    /// By the gradient alone (3DGS, Kerbl et al. 2023).
    Classic,
    /// Insertion only.
    None,
}

/// What the rules need to know of a map.
#[derive(Clone, Copy, Debug)]
pub(in crate::mapping) struct MapSize {
    /// Gaussians in it.
    pub count: usize,
    /// Gaussians that it has space for.
    pub capacity: usize,
    /// Rounds of density control so far.
    pub rounds: u32,
}

/// Densification and pruning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DensityConfig {
    /// Which Gaussians are split, cloned or removed.
    pub strategy: DensityStrategy,
    /// Density is controlled each time after so many keyframes.
    pub every: usize,
    /// Keyframes of the window that score the Gaussians.
    pub views: usize,
    /// Share of a keyframe's steps after which its views score the Gaussians and the density is controlled; the rest of the steps settles
    /// what came of that.
    pub after_share: f32,
    /// Opacity below which a Gaussian is dropped.
    pub min_opacity: f32,
    /// Largest standard deviation, metres.
    pub max_scale_metres: f32,
    /// Thresholds of [`DensityStrategy::MultiView`].
    pub multi_view: MultiViewConfig,
    /// Thresholds of [`DensityStrategy::Classic`].
    pub classic: ClassicConfig,
}

/// Thresholds of multi-view-consistent density control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MultiViewConfig {
    /// An error pixel exceeds the view's mean error by this factor,
    pub error_ratio: f32,
    /// and this much: mean absolute colour error, 0 to 1.
    pub noise: f32,
    /// A Gaussian is split if it covers more error pixels than this in the mean of the views,
    pub error_pixels: f32,
    /// its mean absolute gradient exceeds this: of the loss summed over the image's pixels, for a pixel of motion, so that it means the same at
    /// any resolution,
    pub pixel_gradient: f32,
    /// and its standard deviation this many pixels of the nearest view: finer detail than that no view shows.
    pub split_pixels: f32,
    /// At most this share of the scored Gaussians is divided at once, those with most error pixels first.
    pub max_growth: f32,
    /// Least age of a Gaussian that is split or pruned, keyframes.
    pub min_age: u32,
    /// A Gaussian that never adds more than this to a pixel is removed.
    pub min_weight: f32,
    /// One that never adds more than this to a view is removed too: pixels.
    pub min_contribution: f32,
    /// Opacity below which the half of the Gaussians with more high-error pixels is pruned.
    pub faint_opacity: f32,
}

/// Thresholds of 3DGS' density control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClassicConfig {
    /// Mean gradient (normalised device coordinates) above which a Gaussian is divided.
    pub gradient: f32,
    /// Standard deviation from which on it is split rather than cloned, pixels of the nearest view.
    pub split_pixels: f32,
}

impl Default for DensityConfig {
    fn default() -> Self {
        Self {
            strategy: DensityStrategy::default(),
            every: 2,
            views: 4,
            after_share: 0.6,
            min_opacity: 0.03,
            max_scale_metres: 20.0,
            multi_view: MultiViewConfig::default(),
            classic: ClassicConfig::default(),
        }
    }
}

impl Default for MultiViewConfig {
    fn default() -> Self {
        Self {
            error_ratio: 1.5,
            noise: 0.02,
            error_pixels: 5.0,
            pixel_gradient: 0.6,
            split_pixels: 1.5,
            max_growth: 0.015,
            min_age: 2,
            min_weight: 0.02,
            min_contribution: 1.25,
            faint_opacity: 0.1,
        }
    }
}

impl Default for ClassicConfig {
    fn default() -> Self {
        Self { gradient: 2e-4, split_pixels: 1.5 }
    }
}

impl DensityConfig {
    /// High-error mask of the Gaussian scores.
    pub fn error_pixels(&self) -> ErrorPixels {
        let MultiViewConfig { error_ratio, noise, .. } = self.multi_view;
        ErrorPixels { error_ratio, noise }
    }

    /// The rules for a map, as the GPU has them.
    pub(in crate::mapping) fn setup(&self, map: &MapSize) -> DensitySetup {
        let (v, c) = (&self.multi_view, &self.classic);
        // No Gaussian is old or steep enough for a strategy that does not rule.
        let rules = |strategy, value| if self.strategy == strategy { value } else { f32::MAX };
        DensitySetup {
            count: map.count as u32,
            capacity: map.capacity as u32,
            round: map.rounds as f32,
            min_raw_opacity: raw_opacity_from_opacity(self.min_opacity).max(f32::MIN),
            max_log_scale: self.max_scale_metres.ln(),
            min_age: rules(DensityStrategy::MultiView, v.min_age as f32),
            min_views: MIN_VIEWS,
            min_weight: v.min_weight,
            min_contribution: v.min_contribution,
            faint_raw_opacity: raw_opacity_from_opacity(v.faint_opacity).max(f32::MIN),
            error_pixels: v.error_pixels,
            pixel_gradient: v.pixel_gradient,
            split_log_pixels: v.split_pixels.ln(),
            gradient: rules(DensityStrategy::Classic, c.gradient),
            split_or_clone_log_pixels: c.split_pixels.ln(),
            pad: 0,
        }
    }

    /// A copy without densification.
    pub fn without_growth(&self) -> Self {
        let mut still = self.clone();
        (still.multi_view.max_growth, still.classic.gradient) = (0.0, f32::MAX);
        still
    }

    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        if self.every == 0 || self.views == 0 {
            return Err("every and views must be at least 1".into());
        }
        let (v, c) = (&self.multi_view, &self.classic);
        if !(0.0..=1.0).contains(&self.after_share) {
            return Err(format!("after_share must lie between 0 and 1, not {}", self.after_share));
        }
        let shares = [
            ("min_opacity", self.min_opacity),
            ("multi_view.min_weight", v.min_weight),
            ("multi_view.faint_opacity", v.faint_opacity),
            ("multi_view.noise", v.noise),
        ];
        if let Some((name, value)) = shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            return Err(format!("{name} must lie between 0 and 1, not {value}"));
        }
        let positive = [
            ("max_scale_metres", self.max_scale_metres),
            ("multi_view.split_pixels", v.split_pixels),
            ("classic.split_pixels", c.split_pixels),
        ];
        if let Some((name, value)) = positive.iter().find(|(_, value)| !(value.is_finite() && *value > 0.0)) {
            return Err(format!("{name} must be positive, not {value}"));
        }
        let thresholds = [v.error_ratio, v.error_pixels, v.pixel_gradient, v.max_growth, v.min_contribution, c.gradient];
        if thresholds.iter().any(|t| !(t.is_finite() && *t >= 0.0)) {
            return Err("thresholds must be finite and not negative".into());
        }
        Ok(())
    }
}
