//! Which keyframes the steps after a keyframe learn from.

use fastrand::Rng;

use super::keyframe::MappedKeyframe;
use super::{KeyframeId, WindowConfig};
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

/// The newest keyframes and the older ones that share most landmarks with the newest, newest first; indices. Image-only ones are left out.
pub(super) fn window(keyframes: &[MappedKeyframe], config: &WindowConfig) -> Vec<usize> {
    let full = (0..keyframes.len()).rev().filter(|k| !keyframes[*k].image_only);
    let mut window: Vec<usize> = full.take(config.recent).collect();
    let (Some(&newest), Some(&oldest)) = (window.first(), window.last()) else { return window };
    let older = |id: &KeyframeId| keyframes[..oldest].binary_search_by_key(id, |k| k.id).ok();
    window.extend(keyframes[newest].covisible.iter().filter_map(older).take(config.covisible));
    window
}

/// So many of these keyframes, drawn one by one, each with a probability inversely proportional to one more than the steps `taken` over it. None is
/// drawn twice before all are drawn.
pub(super) fn draw_least_learnt(keyframes: &[usize], taken: impl Fn(usize) -> u32, count: usize, rng: &mut Rng) -> Vec<usize> {
    let mut left: Vec<(usize, f64)> = Vec::new();
    let mut draw = || {
        if left.is_empty() {
            left = keyframes.iter().map(|&k| (k, 1.0 / (1.0 + f64::from(taken(k))))).collect();
        }
        let mut at = rng.f64() * left.iter().map(|(_, weight)| weight).sum::<f64>();
        let drawn = left.iter().position(|(_, weight)| {
            at -= weight;
            at < 0.0
        });
        let drawn = drawn.or(left.len().checked_sub(1))?;
        Some(left.remove(drawn).0)
    };
    (0..count).map_while(|_| draw()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_even_out_the_steps_and_repeat_none_too_soon() {
        let mut rng = Rng::with_seed(3);
        let keyframes = [4, 5, 6, 7, 8, 9];
        let mut steps = [0, 0, 0, 0, 90, 40, 20, 10, 0, 0];
        for _ in 0..30 {
            let drawn = draw_least_learnt(&keyframes, |k| steps[k], 4, &mut rng);
            assert!(drawn.len() == 4 && drawn.iter().enumerate().all(|(i, k)| k >= &4 && !drawn[..i].contains(k)), "{drawn:?}");
            drawn.iter().for_each(|k| steps[*k] += 1);
        }
        // 120 steps in all: the unlearnt ones catch up, and the others are not forgotten.
        assert!(
            steps[9] > 25 && steps[8] > 25 && (90..100).contains(&steps[4]) && steps[4..8].iter().sum::<u32>() > 160,
            "{steps:?}"
        );
    }

    #[test]
    fn more_steps_than_keyframes_are_several_rounds() {
        let mut drawn = draw_least_learnt(&[2, 3], |_| 7, 5, &mut Rng::with_seed(1));
        assert!(drawn[..2] != [2, 2] && drawn[..2] != [3, 3]);
        drawn.sort_unstable();
        assert!(drawn == [2, 2, 2, 3, 3] || drawn == [2, 2, 3, 3, 3]);
        assert!(draw_least_learnt(&[], |_| 0, 3, &mut Rng::with_seed(1)).is_empty());
    }
}
