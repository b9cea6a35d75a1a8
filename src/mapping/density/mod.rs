//! Density control: which Gaussians go, and which are divided. A strategy only returns a [`Plan`]; one pass applies it, prune before grow.

mod classic;
mod multi_view;

use glam::Vec3;

pub use self::config::{ClassicConfig, DensityConfig, DensityStrategy, MultiViewConfig};

use super::gaussian_stats::GaussianHistory;
use crate::optimise::GaussianScore;
use crate::render::{Child, GaussianGeometry, Plan};
use crate::splat::{opacity_from_raw, raw_opacity_from_opacity};

mod config;

/// Input of a density strategy: one Gaussian.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub geometry: GaussianGeometry,
    pub score: GaussianScore,
    pub history: GaussianHistory,
}

/// Decision of a density strategy for one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Decision {
    Keep,
    Remove,
    /// Two smaller ones in its place, along its longest axis.
    Split,
    /// Two of its size in its place, a little apart.
    Clone,
}

impl Candidate {
    /// Its largest standard deviation in the view nearest to it, pixels.
    pub fn pixels(&self) -> f32 {
        self.geometry.log_scale.max_element().exp() / self.score.metres_per_pixel.max(1e-9)
    }

    pub fn opacity(&self) -> f32 {
        opacity_from_raw(self.geometry.raw_opacity)
    }

    fn is_finite(&self) -> bool {
        let g = &self.geometry;
        g.mean.is_finite() && g.raw_opacity.is_finite() && g.log_scale.is_finite() && g.rotation.is_finite()
    }
}

/// Decides on every Gaussian; those with a NaN are removed whatever the strategy. At most `most` are left, undivided ones first.
pub(super) fn plan(candidates: &[Candidate], most: usize, config: &DensityConfig) -> Plan {
    let decisions = match config.strategy {
        DensityStrategy::MultiView => multi_view::decide(candidates, &config.multi_view),
        DensityStrategy::Classic => classic::decide(candidates, &config.classic),
        DensityStrategy::None => vec![Decision::Keep; candidates.len()],
    };
    let mut plan = Plan::default();
    let mut capacity = most.saturating_sub(candidates.len());
    for (i, (candidate, decision)) in (0..).zip(candidates.iter().zip(decisions)) {
        let valid = candidate.is_finite()
            && candidate.opacity() >= config.min_opacity
            && candidate.geometry.log_scale.max_element() <= config.max_scale_metres.ln();
        match decision {
            _ if !valid => {}
            Decision::Remove => {}
            Decision::Split | Decision::Clone if capacity > 0 => {
                plan.children.extend(divide(i, candidate, decision == Decision::Clone));
                capacity -= 1;
            }
            Decision::Keep | Decision::Split | Decision::Clone => plan.keep.push(i),
        }
    }
    plan
}

/// Two in place of one, along its longest axis. Split: narrower ones that look together much as it did (their alphas differ from it by
/// at most 0.07 of its own along the axis). Clone: two like it, with 1 - √(1 - α) each, so that both together let as much light pass.
fn divide(parent: u32, of: &Candidate, clone: bool) -> [Child; 2] {
    let GaussianGeometry { mean, log_scale, rotation, .. } = of.geometry;
    let scale = log_scale.exp();
    let longest = scale.max_position();
    let mut axis = Vec3::ZERO;
    axis[longest] = scale[longest];
    let axis = rotation.normalize() * axis;
    let mut log_scale = log_scale;
    let (apart, opacity) = if clone {
        (0.25, 1.0 - (1.0 - of.opacity()).sqrt())
    } else {
        log_scale[longest] += 0.7f32.ln();
        (0.6, 0.85 * of.opacity())
    };
    let raw_opacity = raw_opacity_from_opacity(opacity);
    [-apart, apart].map(|side| Child { parent, mean: mean + side * axis, raw_opacity, log_scale })
}

#[cfg(test)]
mod tests;
