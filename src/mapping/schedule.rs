//! Which keyframes the steps after a keyframe learn from.

use fastrand::Rng;

use super::WindowConfig;
use super::keyframe::MappedKeyframe;
use crate::optimise::ErrorPixels;
use crate::splat::model::Dropout;

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

/// So many steps over the window, newest first; now and then one over any of the `older` keyframes, so that the map does not forget.
pub(super) fn steps(window: &[usize], older: &[usize], count: usize, rng: &mut Rng, config: &WindowConfig) -> Vec<Step> {
    let draw = |taken: usize| {
        let goes_back = !older.is_empty() && rng.f32() < config.older_share;
        Step::new(if goes_back { older[rng.usize(..older.len())] } else { window[taken % window.len()] })
    };
    (0..count).map(draw).collect()
}
