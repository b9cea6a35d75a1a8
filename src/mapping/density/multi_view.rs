//! Multi-view-consistent densification and pruning (FastGS, arXiv 2511.04283), per keyframe: a Gaussian is divided where several views
//! agree on error pixels within it, and pruned where it contributes to no view.
//!
//! Unlike the released code: pruning is decided first and by order of score, without a draw; an error pixel exceeds a multiple of the mean
//! error, not by the view's extremes; ages are per Gaussian.

use super::{Candidate, Decision, MultiViewConfig};

/// Views that must have shown a Gaussian before it can be called useless.
const MIN_VIEWS: u32 = 3;

pub(super) fn decide(candidates: &[Candidate], config: &MultiViewConfig) -> Vec<Decision> {
    let faint_limit = median_score_of_faint(candidates, config);
    let mut decisions: Vec<Decision> =
        candidates.iter().map(|c| if is_useless(c, faint_limit, config) { Decision::Remove } else { Decision::Keep }).collect();
    let mut coarse: Vec<usize> =
        (0..candidates.len()).filter(|&i| decisions[i] == Decision::Keep && is_too_coarse(&candidates[i], config)).collect();
    let pixels = |i: &usize| candidates[*i].score.error_pixels / candidates[*i].score.views;
    coarse.sort_by(|a, b| pixels(b).total_cmp(&pixels(a)).then(a.cmp(b)));
    let scored = candidates.iter().filter(|c| c.score.views > 0.0).count();
    coarse.truncate((config.max_growth * scored as f32) as usize);
    coarse.into_iter().for_each(|i| decisions[i] = Decision::Split);
    decisions
}

fn is_faint(c: &Candidate, config: &MultiViewConfig) -> bool {
    c.score.views > 0.0 && c.history.age >= config.min_age && c.opacity() < config.faint_opacity
}

/// The pruning score above which a faint Gaussian goes: the median of theirs.
fn median_score_of_faint(candidates: &[Candidate], config: &MultiViewConfig) -> f32 {
    let faint = candidates.iter().filter(|c| is_faint(c, config));
    let mut scores: Vec<f32> = faint.map(|c| c.score.weighted_error_pixels).collect();
    scores.sort_by(f32::total_cmp);
    scores.get(scores.len() / 2).copied().unwrap_or(f32::INFINITY)
}

/// Nothing would be missed without it, or it is faint and stands in the way.
fn is_useless(c: &Candidate, faint_limit: f32, config: &MultiViewConfig) -> bool {
    let adds_little = c.history.best_weight < config.min_weight || c.history.contribution < config.min_contribution;
    let never_seen_well = c.history.views >= MIN_VIEWS && adds_little;
    let in_the_way = is_faint(c, config) && c.score.weighted_error_pixels > faint_limit;
    c.history.age >= config.min_age && (never_seen_well || in_the_way)
}

/// Several views agree that it is too coarse for what they show.
fn is_too_coarse(c: &Candidate, config: &MultiViewConfig) -> bool {
    let views = c.score.views;
    views > 0.0
        && c.history.age >= config.min_age
        && c.score.error_pixels / views > config.error_pixels
        && c.score.absolute_gradient / views > config.absolute_gradient
        && c.pixels() > config.split_pixels
}
