//! Density control of 3DGS (Kerbl et al. 2023), for comparison: what has a large mean gradient is divided, whatever it costs.

use super::{Candidate, ClassicConfig, Verdict};

pub(super) fn decide(candidates: &[Candidate], config: &ClassicConfig) -> Vec<Verdict> {
    let decide = |c: &Candidate| {
        if c.score.views == 0.0 || c.score.gradient / c.score.views < config.gradient {
            Verdict::Keep
        } else if c.pixels() > config.split_pixels {
            Verdict::Split
        } else {
            Verdict::Clone
        }
    };
    candidates.iter().map(decide).collect()
}
