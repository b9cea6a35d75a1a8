//! What an optimiser remembers from one step to the next, apart from the map and its targets: a count, and how large its buffers are.
//! The latter decides nothing by itself, but where memory is limited all that is in use counts.

use serde::{Deserialize, Serialize};

use super::Optimiser;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::optimise::image_buffers;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct OptimiserState {
    /// Steps submitted so far: seeds the draws of tiles, and says when harmonics move.
    steps: usize,
    /// Width and height of the views that there are buffers for, the latest first.
    sizes: Vec<(u32, u32)>,
    gaussians: usize,
    scored: usize,
}

impl Optimiser {
    pub fn state(&self) -> OptimiserState {
        OptimiserState {
            steps: self.steps,
            sizes: self.images.iter().map(|images| images.size).collect(),
            gaussians: self.gaussians,
            scored: self.scores.capacity(),
        }
    }

    /// Becomes, from a new optimiser, the one that a state is of.
    pub fn restore(&mut self, gpu: &Gpu, state: &OptimiserState) -> Result<(), GpuError> {
        self.steps = state.steps;
        for size in state.sizes.iter().rev() {
            image_buffers::choose(&mut self.images, gpu, *size)?;
        }
        self.reserve_gaussians(gpu, state.gaussians)?;
        if state.scored > 0 { self.scores.reserve(gpu, state.scored) } else { Ok(()) }
    }

    /// Room for the gradients by the pose of so many Gaussians.
    pub(super) fn reserve_gaussians(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        if capacity > self.gaussians {
            self.pose_sums = GpuBuffer::storage(gpu, "pose sums", (capacity as u64).div_ceil(256) * 32)?;
            self.gaussians = capacity;
        }
        Ok(())
    }
}
