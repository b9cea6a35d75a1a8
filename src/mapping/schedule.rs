//! Which keyframes the steps after a keyframe learn from.

use fastrand::Rng;

use super::WindowConfig;
use super::keyframe::MappedKeyframe;
use crate::optimise::ErrorPixels;
use crate::splat::model::Dropout;

/// Older keyframes that are drawn before one of the window takes the place.
const TRIES: usize = 32;

/// Training view of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Step {
    pub keyframe: usize,
    /// At half the size.
    pub coarse: bool,
    /// Gaussians that it leaves out.
    pub dropout: Dropout,
    /// Factor on the weights of a planar surface, 0 to 1.
    pub surface_share: f32,
    /// Whether the step also scores the Gaussians.
    pub scored: Option<ErrorPixels>,
}

impl Step {
    pub fn new(keyframe: usize) -> Self {
        Self { keyframe, coarse: false, dropout: Dropout::default(), surface_share: 0.0, scored: None }
    }
}

/// The newest keyframes and the older ones that share most landmarks with the newest, newest first; indices.
pub(super) fn window(keyframes: &[MappedKeyframe], config: &WindowConfig) -> Vec<usize> {
    let len = keyframes.len();
    let recent = len.saturating_sub(config.recent);
    let mut window: Vec<usize> = (recent..len).rev().collect();
    let covisible = &keyframes[len - 1].covisible;
    let older = covisible.iter().filter_map(|id| keyframes[..recent].binary_search_by_key(id, |k| k.id).ok());
    window.extend(older.take(config.covisible));
    window
}

/// So many steps over the window, newest first, of `len` keyframes; now and then any older one that `may` be learnt from, so that the map does not forget.
pub(super) fn steps(
    window: &[usize],
    (len, may): (usize, &dyn Fn(usize) -> bool),
    count: usize,
    rng: &mut Rng,
    config: &WindowConfig,
) -> Vec<Step> {
    let older = len.saturating_sub(config.recent);
    let draw = |taken: usize| {
        let goes_back = len > window.len() && rng.f32() < config.older_share;
        let drawn = if goes_back { (0..TRIES).map(|_| rng.usize(..older.max(1))).find(|k| may(*k)) } else { None };
        Step::new(drawn.unwrap_or(window[taken % window.len()]))
    };
    (0..count).map(draw).collect()
}
