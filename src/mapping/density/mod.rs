//! Density control: which Gaussians go, and which are divided. A strategy only returns a [`Plan`]; one pass applies it, prune before grow.

mod classic;
mod vcd;

use glam::{Quat, Vec3};

pub use self::config::{ClassicConfig, DensityConfig, DensityStrategy, VcdConfig};

use super::ledger::Entry;
use crate::optimise::GaussianScore;
use crate::splat::{opacity_from_raw, raw_opacity_from_opacity};

mod config;

/// What a strategy sees of a Gaussian.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub mean: Vec3,
    pub raw_opacity: f32,
    pub log_scale: Vec3,
    /// World from Gaussian.
    pub rotation: Quat,
    pub score: GaussianScore,
    pub entry: Entry,
}

/// A new Gaussian: its parent with another place, size and opacity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Child {
    pub parent: u32,
    pub mean: Vec3,
    pub raw_opacity: f32,
    pub log_scale: Vec3,
}

/// What is to become of a map; indices are those before.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Plan {
    /// Ascending.
    pub keep: Vec<u32>,
    pub children: Vec<Child>,
}

/// What a strategy says of one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
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
        self.log_scale.max_element().exp() / self.score.metres_per_pixel.max(1e-9)
    }

    pub fn opacity(&self) -> f32 {
        opacity_from_raw(self.raw_opacity)
    }

    fn is_finite(&self) -> bool {
        self.mean.is_finite() && self.raw_opacity.is_finite() && self.log_scale.is_finite() && self.rotation.is_finite()
    }
}

/// Judges every Gaussian; those gone bad (NaN) are removed whatever the strategy.
pub(super) fn plan(candidates: &[Candidate], config: &DensityConfig) -> Plan {
    let verdicts = match config.strategy {
        DensityStrategy::Vcd => vcd::judge(candidates, &config.vcd),
        DensityStrategy::Classic => classic::judge(candidates, &config.classic),
        DensityStrategy::None => vec![Verdict::Keep; candidates.len()],
    };
    let mut plan = Plan::default();
    for (i, (candidate, verdict)) in (0..).zip(candidates.iter().zip(verdicts)) {
        let worth = candidate.is_finite()
            && candidate.opacity() >= config.min_opacity
            && candidate.log_scale.max_element() <= config.max_scale_metres.ln();
        match verdict {
            _ if !worth => {}
            Verdict::Remove => {}
            Verdict::Keep => plan.keep.push(i),
            Verdict::Split | Verdict::Clone => plan.children.extend(divide(i, candidate, verdict == Verdict::Clone)),
        }
    }
    plan
}

/// Two in place of one, along its longest axis. Split: narrower ones that look together much as it did (their alphas differ from it by
/// at most 0.07 of its own along the axis). Clone: two like it, with 1 - √(1 - α) each, so that both together let as much light pass.
fn divide(parent: u32, of: &Candidate, clone: bool) -> [Child; 2] {
    let scale = of.log_scale.exp();
    let longest = scale.max_position();
    let mut axis = Vec3::ZERO;
    axis[longest] = scale[longest];
    let axis = of.rotation.normalize() * axis;
    let mut log_scale = of.log_scale;
    let (apart, opacity) = if clone {
        (0.25, 1.0 - (1.0 - of.opacity()).sqrt())
    } else {
        log_scale[longest] += 0.7f32.ln();
        (0.6, 0.85 * of.opacity())
    };
    let raw_opacity = raw_opacity_from_opacity(opacity);
    [-apart, apart].map(|side| Child { parent, mean: of.mean + side * axis, raw_opacity, log_scale })
}
