//! The final refinement of a map larger than the GPU's memory: neighbouring keyframes whose views fit the GPU are refined together for a while, with
//! all others that see enough of it, then the next ones.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::Mapper;
use super::paging::FREE_DIVISOR;
use crate::mapping::MappingError;

/// Least rounds of a refinement: what one stay does to its neighbours, the next round repairs.
const LEAST_ROUNDS: usize = 6;
/// Epochs over the keyframes of a stay, about, where there are enough for more rounds; and always, where time bounds the refinement.
const EPOCHS_A_STAY: usize = 3;

/// The turns of the keyframes in a final refinement: in each round, every keyframe has one. Rates fall with the round and within each stay, so that
/// they end alike everywhere.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Turns {
    /// Unknown where time bounds the refinement.
    rounds: Option<usize>,
    /// Of each keyframe, so far; none before a refinement.
    taken: Vec<usize>,
    /// The stay under way: its round and its steps.
    stay: Option<(usize, usize)>,
}

impl Turns {
    /// Those of a refinement of so many steps, if that is known.
    pub fn new(keyframes: usize, steps: Option<usize>) -> Self {
        let rounds = |steps: usize| (steps / (EPOCHS_A_STAY * keyframes).max(1)).max(LEAST_ROUNDS);
        Self { rounds: steps.map(rounds), taken: vec![0; keyframes], stay: None }
    }

    /// Whether a refinement has begun.
    pub fn have_begun(&self) -> bool {
        !self.taken.is_empty()
    }

    /// No stay is under way: all Gaussians are on the GPU.
    pub fn end_stay(&mut self) {
        self.stay = None;
    }

    /// Share of its steps that a keyframe of the stay under way will have had, when so many of the stay's are left.
    pub fn progress(&self, left: usize) -> Option<f32> {
        let ((round, steps), rounds) = (self.stay?, self.rounds?);
        let done = 1.0 - left as f32 / steps.max(1) as f32;
        Some(((round as f32 + done) / rounds as f32).min(1.0))
    }

    /// The round under way, and the first keyframe whose turn is still to come in it.
    fn next(&self) -> Option<(usize, usize)> {
        let round = *self.taken.iter().min()?;
        Some((round, self.taken.iter().position(|taken| *taken == round)?))
    }

    /// Begins a stay, in which these keyframes have their turns, if they are still to come. Returns its steps: of `left` ones, the share of the turns.
    fn take(&mut self, round: usize, stay: &[usize], left: usize) -> usize {
        let is_due = |taken: usize| taken == round;
        let turns = stay.iter().filter(|k| is_due(self.taken[**k])).count();
        let due = self.taken.iter().filter(|taken| is_due(**taken)).count();
        let steps = match self.rounds {
            Some(rounds) if round < rounds => (left * turns).div_ceil(due + self.taken.len() * (rounds - 1 - round)),
            _ => EPOCHS_A_STAY * stay.len(),
        };
        for k in stay {
            self.taken[*k] = self.taken[*k].max(round + 1);
        }
        self.stay = Some((round, steps));
        steps
    }
}

impl Mapper {
    /// Steps of the next stay of the final refinement, after what its first keyframe sees has come to the GPU; none where no view fits it. `left`: steps
    /// left of the refinement.
    pub(super) fn next_stay(&mut self, left: usize) -> Result<Vec<usize>, MappingError> {
        for _ in 0..self.keyframes.len() {
            let Some((round, first)) = self.turns.next() else { break };
            let mut due = self.keyframes_near(first);
            due.retain(|k| self.turns.taken[*k] == round);
            self.needing = self.fitting(&due)?;
            self.page_in()?;
            self.find_learnable();
            let mut stay = self.learnable(0..self.keyframes.len());
            if stay.binary_search(&first).is_err() {
                // It sees more than fits.
                self.turns.taken[first] += 1;
                continue;
            }
            let steps = self.turns.take(round, &stay, left);
            tracing::debug!(round, steps, keyframes = stay.len(), due = due.len(), resident = self.cloud.len(), "stay");
            let mut drawn = Vec::with_capacity(steps);
            while drawn.len() < steps {
                self.rng.shuffle(&mut stay);
                drawn.extend(stay.iter().take(steps - drawn.len()));
            }
            return Ok(drawn);
        }
        Ok(Vec::new())
    }

    /// The first of these keyframes, as many as have room for what they see on the GPU beside each other.
    fn fitting(&self, keyframes: &[usize]) -> Result<Vec<usize>, MappingError> {
        let room = self.most_on_gpu() - self.most_on_gpu() / FREE_DIVISOR;
        let groups = self.groups()?;
        let (mut here, mut away) = (vec![false; groups.len()], BTreeSet::new());
        let mut gaussians = self.cloud.frozen();
        let mut fitting = Vec::new();
        for k in keyframes {
            let outlook = self.keyframes[*k].outlook();
            for (group, is_counted) in groups.iter().zip(&mut here).filter(|(_, is_counted)| !**is_counted) {
                *is_counted = outlook.sees(&group.bounds);
                gaussians += if *is_counted { group.places.len() } else { 0 };
            }
            let new = self.chunks.seen_by(&outlook).into_iter().filter(|chunk| away.insert(*chunk));
            gaussians += new.map(|chunk| self.chunks.gaussians(chunk)).sum::<usize>();
            if gaussians > room && !fitting.is_empty() {
                break;
            }
            fitting.push(*k);
        }
        Ok(fitting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_share_the_steps_and_rates_end_alike_everywhere() {
        // Ten keyframes in stays of four that overlap by two.
        let mut turns = Turns::new(10, Some(150));
        let (rounds, mut left, mut taken, mut ends) = (LEAST_ROUNDS as f32, 150, vec![0; 10], Vec::new());
        while let Some((round, first)) = turns.next().filter(|(round, _)| *round < LEAST_ROUNDS) {
            let stay: Vec<usize> = (first.saturating_sub(2)..10.min(first + 4)).collect();
            let steps = turns.take(round, &stay, left);
            assert_eq!(turns.progress(steps), Some(round as f32 / rounds));
            ends.push((round, turns.progress(0).unwrap()));
            left -= steps;
            stay.iter().for_each(|k| taken[*k] += 1);
        }
        assert_eq!(left, 0);
        assert!(taken.iter().all(|turns| *turns >= LEAST_ROUNDS));
        assert!(ends.iter().all(|(round, end)| *end == (*round as f32 + 1.0) / rounds), "{ends:?}");
        // Many steps make more rounds, and where time bounds them nobody knows how many.
        assert_eq!(Turns::new(10, Some(300)).rounds, Some(10));
        let mut endless = Turns::new(10, None);
        assert_eq!((endless.take(0, &[0, 1], usize::MAX), endless.progress(3)), (2 * EPOCHS_A_STAY, None));
    }
}
