//! Density control's verdict on a Gaussian, and its division, by their definition; twin of `shaders/density_verdicts.wgsl`,
//! `shaders/density_history.wgsl` and `shaders/divide.wgsl`. In f32 like these: what counts is on which side of a threshold a value lies.

use glam::Vec3;

use crate::optimise::GaussianScore;
use crate::render::layout::{
    DensitySetup, FAINT, SEEN, VERDICT_BITS, VERDICT_CLONE, VERDICT_KEEP, VERDICT_REMOVE, VERDICT_SPLIT,
};
use crate::render::{Division, GaussianHistory};
use crate::splat::{Gaussian, opacity_from_raw, raw_opacity_from_opacity};

/// A history after scored views.
pub fn remembered(history: &GaussianHistory, score: &GaussianScore) -> GaussianHistory {
    GaussianHistory {
        views: history.views + score.views,
        best_weight: history.best_weight.max(score.weight_max),
        contribution: history.contribution.max(score.weight_sum / score.views.max(1.0)),
        came: history.came,
    }
}

/// The verdict with its flags and score. `history` is that before the scored views.
pub fn verdict(setup: &DensitySetup, gaussian: &Gaussian, score: &GaussianScore, history: &GaussianHistory) -> u32 {
    let history = remembered(history, score);
    let is_old = setup.round - history.came >= setup.min_age;
    let is_seen = score.views > 0.0;
    let longest = gaussian.log_scale.max_element();
    let log_pixels = longest - score.metres_per_pixel.max(1e-9).ln();
    let is_useless = is_old
        && history.views >= setup.min_views
        && (history.best_weight < setup.min_weight || history.contribution < setup.min_contribution);
    let is_faint = is_old && is_seen && gaussian.raw_opacity < setup.faint_raw_opacity;
    let is_coarse = is_old
        && is_seen
        && score.error_pixels / score.views > setup.error_pixels
        && score.absolute_gradient / score.views > setup.pixel_gradient
        && log_pixels > setup.split_log_pixels;
    let is_valid = gaussian.mean.is_finite()
        && gaussian.raw_opacity.is_finite()
        && gaussian.log_scale.is_finite()
        && gaussian.rotation.is_finite()
        && gaussian.raw_opacity >= setup.min_raw_opacity
        && longest <= setup.max_log_scale;
    let is_steep = is_seen && score.gradient / score.views >= setup.gradient;
    let verdict = match () {
        () if !is_valid || is_useless => VERDICT_REMOVE,
        () if is_steep && log_pixels > setup.split_or_clone_log_pixels => VERDICT_SPLIT,
        () if is_steep => VERDICT_CLONE,
        () if is_coarse && !is_faint => VERDICT_SPLIT,
        () => VERDICT_KEEP,
    };
    let rank = match () {
        () if is_faint => score.weighted_error_pixels,
        () if is_coarse && !is_useless => score.error_pixels / score.views,
        () => 0.0,
    };
    let flags = if is_seen { SEEN } else { 0 } | if is_faint { FAINT } else { 0 };
    (rank.to_bits() & !VERDICT_BITS) | verdict | flags
}

/// Two in place of one, along its longest axis.
pub fn divide(of: &Gaussian, division: Division) -> [Gaussian; 2] {
    let longest = of.log_scale.max_position();
    let mut axis = Vec3::ZERO;
    axis[longest] = of.log_scale[longest].exp();
    let axis = of.rotation.normalize() * axis;
    let (alpha, mut log_scale) = (opacity_from_raw(of.raw_opacity), of.log_scale);
    let (apart, opacity) = match division {
        Division::Clone => (0.25, 1.0 - (1.0 - alpha).sqrt()),
        Division::Split => {
            log_scale[longest] += 0.7f32.ln();
            (0.6, 0.85 * alpha)
        }
    };
    let raw_opacity = raw_opacity_from_opacity(opacity);
    [-apart, apart].map(|side| Gaussian { mean: of.mean + side * axis, raw_opacity, log_scale, ..of.clone() })
}
