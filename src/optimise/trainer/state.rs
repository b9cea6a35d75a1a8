//! State of a trainer between two steps, apart from the map and its targets: the number of steps and the capacities of its buffers.
//! The capacity for intersections decides which steps overflow and are repeated; the others count where memory is limited.

use serde::{Deserialize, Serialize};

use super::Trainer;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::optimise::image_buffers;
use crate::render::Capacities;

/// Number of steps and buffer capacities of a [`Trainer`].
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct TrainerState {
    /// Steps submitted so far: seeds the draws of tiles, and says when harmonics move.
    steps: usize,
    /// Width and height of the views that there are buffers for, the latest first.
    sizes: Vec<(u32, u32)>,
    gaussians: usize,
    scored: usize,
    rasterizer: Capacities,
}

impl Trainer {
    /// The state to restore a trainer from.
    pub fn state(&self) -> TrainerState {
        TrainerState {
            steps: self.steps,
            sizes: self.images.iter().map(|images| images.size).collect(),
            gaussians: self.gaussians,
            scored: self.scores.capacity(),
            rasterizer: self.rasterizer.capacities(),
        }
    }

    /// Puts a new trainer into the given state.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn restore(&mut self, state: &TrainerState) -> Result<(), GpuError> {
        let gpu = &self.rasterizer.gpu().clone();
        self.rasterizer.reserve(state.rasterizer)?;
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
