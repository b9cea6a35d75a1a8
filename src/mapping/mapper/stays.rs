//! The final refinement of a map larger than the GPU's memory: neighbouring keyframes whose views fit the GPU are refined together for some epochs, with
//! all others that see enough of it, then the next ones.

use std::collections::BTreeSet;

use super::Mapper;
use super::paging::FREE_DIVISOR;
use crate::mapping::MappingError;

/// Epochs over the keyframes of a stay.
const EPOCHS_A_STAY: usize = 3;

impl Mapper {
    /// The keyframes of the next stay of the final refinement, [`EPOCHS_A_STAY`] times each, after what those that were visited least see has come to the
    /// GPU; none where no view fits it.
    pub(super) fn next_stay(&mut self) -> Result<Vec<usize>, MappingError> {
        for _ in 0..self.keyframes.len() {
            let fewest = self.visits.iter().copied().min().unwrap_or(0);
            let Some(first) = self.visits.iter().position(|visits| *visits == fewest) else { break };
            let mut due = self.keyframes_near(first);
            due.retain(|k| self.visits[*k] == fewest);
            self.needing = self.fitting(&due)?;
            self.page_in()?;
            self.find_learnable();
            let mut stay = self.learnable(0..self.keyframes.len());
            // One that sees more than fits is left out of this round of visits.
            let is_visited = stay.binary_search(&first).is_ok();
            let visited = if is_visited { &stay[..] } else { &[first] };
            visited.iter().for_each(|k| self.visits[*k] += EPOCHS_A_STAY as u32);
            tracing::debug!(keyframes = stay.len(), due = due.len(), resident = self.cloud.len(), "stay");
            if is_visited {
                let mut epochs = Vec::with_capacity(stay.len() * EPOCHS_A_STAY);
                for _ in 0..EPOCHS_A_STAY {
                    self.rng.shuffle(&mut stay);
                    epochs.extend_from_slice(&stay);
                }
                return Ok(epochs);
            }
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
                *is_counted = outlook.sees(&group.ball);
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
