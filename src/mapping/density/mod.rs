//! Density control: which Gaussians go, and which are divided. The GPU gives a verdict on each (`shaders/density_verdicts.wgsl`); the host
//! ranks those that compete and makes one plan of it, prune before grow.
//!
//! Multi-view-consistent densification and pruning (FastGS, arXiv 2511.04283), per keyframe: a Gaussian is divided where several views
//! agree on error pixels within it, and pruned where it contributes to no view. Unlike the released code: pruning is decided first and by
//! order of score, without a draw; an error pixel exceeds a multiple of the mean error, not by the view's extremes; ages are per Gaussian;
//! faint Gaussians are not divided.
//!
//! 3DGS (Kerbl et al. 2023), for comparison: what has a large mean gradient is divided, whatever it costs.

mod config;

pub(super) use self::config::MapSize;
pub use self::config::{ClassicConfig, DensityConfig, DensityStrategy, MultiViewConfig};

use crate::render::layout::{FAINT, SEEN, VERDICT_BITS, VERDICT_CLONE, VERDICT_REMOVE, VERDICT_SPLIT};
use crate::render::{Division, Plan};

/// Bits of a verdict without its flags.
const VERDICT: u32 = VERDICT_BITS & !(SEEN | FAINT);

/// The change that verdicts on all Gaussians lead to, `[N]`. At most `most` are left, undivided ones first.
pub(super) fn plan(verdicts: &[u32], most: usize, config: &DensityConfig) -> Plan {
    // Most Gaussians stay as they are.
    let (mut marked, mut scored) = (Vec::new(), 0);
    for (i, word) in (0u32..).zip(verdicts.iter().copied()) {
        scored += usize::from(word & SEEN != 0);
        if word & (VERDICT | FAINT) != 0 {
            marked.push((i, word));
        }
    }
    let faint_limit = median_score_of_faint(&marked);
    let is_removed = |word: u32| word & VERDICT == VERDICT_REMOVE || (word & FAINT != 0 && score(word) > faint_limit);
    let chosen = chosen(&marked, scored, config);
    let mut chosen = chosen.iter().copied().peekable();
    let mut room = most.saturating_sub(verdicts.len());
    let mut plan = Plan::default();
    for (i, word) in marked {
        let division = chosen.next_if(|(divided, _)| *divided == i).filter(|_| room > 0);
        if let Some(division) = division {
            plan.divided.push(division);
            room -= 1;
        }
        if division.is_some() || is_removed(word) {
            plan.removed.push(i);
        }
    }
    plan
}

fn score(word: u32) -> f32 {
    f32::from_bits(word & !VERDICT_BITS)
}

/// Those to be divided if there is room, ascending: of those that are too coarse for several views at most a share of the scored ones, those
/// with most error pixels first.
fn chosen(marked: &[(u32, u32)], scored: usize, config: &DensityConfig) -> Vec<(u32, Division)> {
    let division = |word: u32| match word & VERDICT {
        VERDICT_SPLIT => Some(Division::Split),
        VERDICT_CLONE => Some(Division::Clone),
        _ => None,
    };
    let dividing = marked.iter().filter_map(|&(i, word)| Some((i, division(word)?, score(word))));
    let mut dividing: Vec<(u32, Division, f32)> = dividing.collect();
    let most = (config.multi_view.max_growth * scored as f32) as usize;
    if config.strategy == DensityStrategy::MultiView && dividing.len() > most {
        dividing.select_nth_unstable_by(most, |a, b| b.2.total_cmp(&a.2).then(a.0.cmp(&b.0)));
        dividing.truncate(most);
        dividing.sort_unstable_by_key(|(i, ..)| *i);
    }
    dividing.into_iter().map(|(i, division, _)| (i, division)).collect()
}

/// The score above which a faint Gaussian goes: the median of theirs.
fn median_score_of_faint(marked: &[(u32, u32)]) -> f32 {
    let mut scores: Vec<f32> = marked.iter().filter(|(_, word)| word & FAINT != 0).map(|(_, word)| score(*word)).collect();
    let middle = scores.len() / 2;
    if scores.is_empty() { f32::INFINITY } else { *scores.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

#[cfg(test)]
mod tests;
