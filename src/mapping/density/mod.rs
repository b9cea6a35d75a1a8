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

/// Judges every Gaussian; those gone bad (NaN) are removed whatever the strategy. At most `most` are left, undivided ones first.
pub(super) fn plan(candidates: &[Candidate], most: usize, config: &DensityConfig) -> Plan {
    let verdicts = match config.strategy {
        DensityStrategy::MultiView => multi_view::judge(candidates, &config.multi_view),
        DensityStrategy::Classic => classic::judge(candidates, &config.classic),
        DensityStrategy::None => vec![Verdict::Keep; candidates.len()],
    };
    let mut plan = Plan::default();
    let mut room = most.saturating_sub(candidates.len());
    for (i, (candidate, verdict)) in (0..).zip(candidates.iter().zip(verdicts)) {
        let valid = candidate.is_finite()
            && candidate.opacity() >= config.min_opacity
            && candidate.geometry.log_scale.max_element() <= config.max_scale_metres.ln();
        match verdict {
            _ if !valid => {}
            Verdict::Remove => {}
            Verdict::Split | Verdict::Clone if room > 0 => {
                plan.children.extend(divide(i, candidate, verdict == Verdict::Clone));
                room -= 1;
            }
            Verdict::Keep | Verdict::Split | Verdict::Clone => plan.keep.push(i),
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
mod tests {
    use super::*;
    use glam::Quat;

    /// A disc of 10 cm by 2 cm a metre away, well seen and well placed.
    fn good() -> Candidate {
        Candidate {
            geometry: GaussianGeometry {
                mean: Vec3::new(0.0, 0.0, 1.0),
                raw_opacity: raw_opacity_from_opacity(0.6),
                log_scale: Vec3::new(0.02, 0.1, 0.01).map(f32::ln),
                rotation: Quat::from_rotation_z(std::f32::consts::FRAC_PI_2),
            },
            score: GaussianScore {
                weight_sum: 80.0,
                weight_max: 0.5,
                views: 4.0,
                metres_per_pixel: 0.005,
                ..GaussianScore::default()
            },
            history: GaussianHistory { age: 5, views: 12, best_weight: 0.5, contribution: 20.0, anchor: 0 },
        }
    }

    fn shaped(mut candidate: Candidate, change: impl Fn(&mut GaussianGeometry)) -> Candidate {
        change(&mut candidate.geometry);
        candidate
    }

    fn wrong() -> Candidate {
        let score = GaussianScore {
            wrong_pixels: 80.0,
            weighted_wrong_pixels: 8.0,
            absolute_gradient: 0.1,
            gradient: 0.05,
            ..good().score
        };
        Candidate { score, ..good() }
    }

    #[test]
    fn vcd_divides_what_several_views_call_too_coarse_and_nothing_else() {
        let config = DensityConfig {
            multi_view: MultiViewConfig { max_growth: 1.0, ..MultiViewConfig::default() },
            ..DensityConfig::default()
        };
        let fine = shaped(wrong(), |g| g.log_scale = Vec3::splat(0.001f32.ln()));
        let young = Candidate { history: GaussianHistory { age: 0, ..good().history }, ..wrong() };
        let unseen = Candidate { score: GaussianScore::default(), ..wrong() };
        let plan = plan(&[good(), wrong(), fine, young, unseen], 100, &config);
        assert_eq!(plan.keep, [0, 2, 3, 4]);
        let [a, b] = &plan.children[..] else { panic!("{:?}", plan.children) };
        assert_eq!((a.parent, b.parent), (1, 1));
        // Along the long axis, which the rotation lays along -x.
        assert!((a.mean - b.mean).length() > 0.1 && (a.mean - b.mean).y.abs() < 1e-6);
        assert!((a.mean + b.mean - 2.0 * wrong().geometry.mean).length() < 1e-6 && a.log_scale.y < wrong().geometry.log_scale.y);
    }

    #[test]
    fn what_is_never_seen_and_what_went_bad_goes() {
        let config = DensityConfig::default();
        let hidden = Candidate { history: GaussianHistory { best_weight: 0.001, ..good().history }, ..good() };
        let speck = Candidate { history: GaussianHistory { contribution: 0.5, ..good().history }, ..good() };
        let new = Candidate { history: GaussianHistory::default(), ..hidden };
        let nan = shaped(good(), |g| g.mean = Vec3::NAN);
        let faint = shaped(good(), |g| g.raw_opacity = raw_opacity_from_opacity(0.01));
        let huge = shaped(good(), |g| g.log_scale = Vec3::splat(4.0));
        let all = [good(), hidden, new, nan, faint, huge, speck];
        assert_eq!(plan(&all, 100, &config).keep, [0, 2]);
        // Without control of density only what went bad goes.
        let none = DensityConfig { strategy: DensityStrategy::None, ..config };
        assert_eq!(plan(&all, 100, &none).keep, [0, 1, 2, 6]);
    }

    #[test]
    fn no_strategy_grows_a_map_beyond_its_room() {
        for strategy in [DensityStrategy::MultiView, DensityStrategy::Classic] {
            let multi_view = MultiViewConfig { max_growth: 1.0, ..MultiViewConfig::default() };
            let config = DensityConfig { strategy, multi_view, ..DensityConfig::default() };
            let plan = plan(&[wrong(); 10], 13, &config);
            assert_eq!((plan.keep.len(), plan.children.len()), (7, 6));
        }
    }
}
