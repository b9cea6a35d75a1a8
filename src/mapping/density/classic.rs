//! Density control of 3DGS (Kerbl et al. 2023), for comparison: what has a large mean gradient is divided, whatever it costs.

use super::{Candidate, ClassicConfig, Decision};

pub(super) fn decide(candidates: &[Candidate], config: &ClassicConfig) -> Vec<Decision> {
    let decide = |c: &Candidate| {
        if c.score.views == 0.0 || c.score.gradient / c.score.views < config.gradient {
            Decision::Keep
        } else if c.pixels() > config.split_pixels {
            Decision::Split
        } else {
            Decision::Clone
        }
    };
    candidates.iter().map(decide).collect()
}
