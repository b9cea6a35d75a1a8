//! State of a trainer between two steps, apart from the map and its targets: the number of steps and the capacities of its buffers.
//! The capacity for intersections decides which steps overflow and are repeated; the others count where memory is limited.

use serde::{Deserialize, Serialize};

use super::Trainer;
use crate::gpu::GpuError;
use crate::render::Capacities;

/// Number of steps and buffer capacities of a [`Trainer`].
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct TrainerState {
    /// Steps submitted so far: seeds the draws of tiles, and says when harmonics move.
    steps: usize,
    /// Width and height of the views that there are buffers for, the latest first, and whether targets were streamed to them.
    sizes: Vec<((u32, u32), bool)>,
    /// Gaussians that there is room for among the scores.
    scored: usize,
    /// Cells that there is room for in a survey.
    surveyed: u32,
    rasterizer: Capacities,
}

impl TrainerState {
    /// Gaussians that there is room for among the scores; none before the first are scored.
    pub fn scored(&self) -> usize {
        self.scored
    }
}

impl Trainer {
    /// The state to restore a trainer from.
    pub fn state(&self) -> TrainerState {
        TrainerState {
            steps: self.steps,
            sizes: self.images.iter().map(|images| (images.size, images.streams())).collect(),
            scored: self.scores.capacity(),
            surveyed: self.survey.capacity(),
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
        for (size, streams) in state.sizes.iter().rev() {
            self.choose_images(*size)?;
            if *streams {
                self.images[0].prepare_to_stream(gpu)?;
            }
        }
        self.survey.reserve(gpu, state.surveyed)?;
        if state.scored > 0 { self.scores.reserve(gpu, state.scored) } else { Ok(()) }
    }
}
