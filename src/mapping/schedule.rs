//! Which keyframe each step learns from, at which size, and when further steps gain nothing.

use std::collections::BTreeMap;

use fastrand::Rng;

use super::keyframe::MappedKeyframe;
use super::{ScheduleConfig, WindowConfig};

/// So many steps are classified together,
const CLASSIFIED: usize = 10;
/// and so many of them must be of views seen before in the same session, or their gain says nothing.
const MIN_REPEATED: usize = 4;

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

/// The steps after one keyframe.
#[derive(Debug)]
pub(super) struct Session {
    window: Vec<usize>,
    steps: usize,
    taken: usize,
    converged: bool,
    /// The loss of each view at its last step of this session.
    losses: BTreeMap<usize, f32>,
    /// Since the last classification.
    gain: Gain,
}

/// How the losses of views fell that were seen twice.
#[derive(Clone, Copy, Debug, Default)]
struct Gain {
    steps: usize,
    repeated: usize,
    before: f32,
    after: f32,
}

/// Training view of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Step {
    pub keyframe: usize,
    /// At half the size.
    pub coarse: bool,
    /// Factor on all learning rates.
    pub lr_scale: f32,
}

impl Session {
    pub fn new(window: Vec<usize>, steps: usize) -> Self {
        Self { window, steps, taken: 0, converged: false, losses: BTreeMap::new(), gain: Gain::default() }
    }

    pub fn taken(&self) -> usize {
        self.taken
    }

    /// Whether `end` steps are taken, or more are of no use.
    pub fn is_over(&self, end: usize) -> bool {
        self.taken >= end || self.converged
    }

    /// The next steps, at most `count`: the window in turn, newest first, and now and then any other keyframe, so that the map does not
    /// forget.
    pub fn next(
        &mut self,
        count: usize,
        keyframes: &[MappedKeyframe],
        rng: &mut Rng,
        window: &WindowConfig,
        schedule: &ScheduleConfig,
    ) -> Vec<Step> {
        let count = count.min(self.steps - self.taken);
        let draw = |taken: usize| {
            let keyframe = if keyframes.len() > self.window.len() && rng.f32() < window.older_share {
                draw_older(keyframes, window.recent, rng, schedule.draw_by_loss)
            } else {
                self.window[taken % self.window.len()]
            };
            let elapsed = taken as f32 / self.steps as f32;
            Step { keyframe, coarse: elapsed < schedule.coarse_share, lr_scale: 1.0 - (1.0 - window.final_lr_scale) * elapsed }
        };
        let steps = (self.taken..self.taken + count).map(draw).collect();
        self.taken += count;
        steps
    }

    /// Takes note of a batch's losses; sees whether more steps still gain.
    pub fn take_note(&mut self, batch: &[Step], losses: &[f32], min_gain: f32) {
        for (step, &loss) in batch.iter().zip(losses) {
            self.gain.steps += 1;
            // Losses at different sizes don't compare.
            let view = 2 * step.keyframe + usize::from(step.coarse);
            if let Some(last) = self.losses.insert(view, loss) {
                self.gain.repeated += 1;
                self.gain.before += last;
                self.gain.after += loss;
            }
        }
        if self.gain.steps >= CLASSIFIED {
            let Gain { repeated, before, after, .. } = std::mem::take(&mut self.gain);
            self.converged = min_gain > 0.0 && repeated >= MIN_REPEATED && before - after < min_gain * before;
        }
    }
}

/// Any keyframe before the newest ones; those with more loss more often, if so wished.
fn draw_older(keyframes: &[MappedKeyframe], recent: usize, rng: &mut Rng, by_loss: bool) -> usize {
    let older = keyframes[..keyframes.len() - recent.min(keyframes.len() - 1)].iter().enumerate();
    let weight = |k: &MappedKeyframe| if by_loss { k.loss } else { 1.0 };
    let total: f32 = older.clone().map(|(_, k)| weight(k)).sum();
    let mut left = rng.f32() * total;
    let mut chosen = 0;
    for (index, keyframe) in older {
        chosen = index;
        left -= weight(keyframe);
        if left < 0.0 {
            break;
        }
    }
    chosen
}
