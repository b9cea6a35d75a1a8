//! A mapper's state, to go on elsewhere to the bit. The keyframes' images are left out: they come again with the recording.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use fastrand::Rng;
use serde::{Deserialize, Serialize};

use super::stays::Turns;
use super::{FinalRefinement, Mapper};
use crate::gpu::Gpu;
use crate::mapping::anchors::Anchors;
use crate::mapping::chunks::{Chunks, ChunksState};
use crate::mapping::keyframe::{KeyframeState, MappedKeyframe};
use crate::mapping::{Keyframe, MappingConfig, MappingError};
use crate::optimise::TrainerState;
use crate::render::{CloudState, GpuCloud};

/// Between two keyframes, or between two rounds of a refinement.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct MapperState {
    cloud: CloudState,
    trainer: TrainerState,
    anchors: Anchors,
    chunks: ChunksState,
    learnable: Vec<usize>,
    turns: Turns,
    stepped_capacity: usize,
    inserted: usize,
    keyframes: Vec<KeyframeState>,
    rng: u64,
    step_times: Vec<Duration>,
    /// Keyframes left of the running epoch.
    epoch: Vec<usize>,
    has_initial_map: bool,
    refinement: Option<FinalRefinement>,
}

impl Mapper {
    /// The state, and where the refinement stands if it has begun.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn state(&self, refinement: Option<&FinalRefinement>) -> Result<MapperState, MappingError> {
        Ok(MapperState {
            cloud: self.cloud.state(&self.gpu)?,
            trainer: self.trainer.state(),
            anchors: self.anchors.clone(),
            chunks: self.chunks.state()?,
            learnable: self.learnable.clone(),
            turns: self.turns.clone(),
            stepped_capacity: self.stepped_capacity,
            inserted: self.inserted,
            keyframes: self.keyframes.iter().map(|keyframe| keyframe.state(&self.gpu, &self.images)).collect::<Result<_, _>>()?,
            rng: self.rng.get_seed(),
            step_times: self.step_times.clone(),
            epoch: self.epoch.clone(),
            has_initial_map: self.has_initial_map,
            refinement: refinement.cloned(),
        })
    }

    /// The mapper of a state, without its keyframes: see [`Self::insert_again`]. `chunks` is the file of what was not on the GPU.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn restore(
        gpu: Arc<Gpu>,
        config: &MappingConfig,
        state: &MapperState,
        chunks: Option<PathBuf>,
    ) -> Result<Self, MappingError> {
        let mut mapper = Self::new(gpu, config)?;
        mapper.chunks = Chunks::restore(chunks, &state.chunks)?;
        let cloud = GpuCloud::restore(&mapper.gpu, config.sh_degree, &state.cloud)?.ok_or(MappingError::State)?;
        mapper.cloud = cloud.with_antialiasing(config.antialiased);
        if state.anchors.len() != mapper.cloud.len() {
            return Err(MappingError::State);
        }
        mapper.trainer.restore(&state.trainer)?;
        // Verdicts have the scores' capacity: what counts where memory is limited is as it was.
        if state.trainer.scored() > 0 {
            mapper.density.reserve(&mapper.gpu, state.trainer.scored() as u32)?;
        }
        mapper.anchors = state.anchors.clone();
        mapper.learnable = state.learnable.clone();
        mapper.turns = state.turns.clone();
        mapper.stepped_capacity = state.stepped_capacity;
        mapper.inserted = state.inserted;
        mapper.rng = Rng::with_seed(state.rng);
        mapper.step_times = state.step_times.clone();
        mapper.epoch = state.epoch.clone();
        mapper.has_initial_map = state.has_initial_map;
        Ok(mapper)
    }

    /// Takes in the next keyframe of the state that the mapper was restored from, as it was then, and nothing else happens.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn insert_again(&mut self, keyframe: &Keyframe, state: &MapperState) -> Result<(), MappingError> {
        let not_the_same = || MappingError::NotTheSame { id: keyframe.id };
        let Some(place) = state.keyframes.iter().position(|then| then.id == keyframe.id) else {
            // Passed over then, too, or removed since.
            return Ok(());
        };
        let then = state.keyframes.get(place).filter(|_| place == self.keyframes.len()).ok_or_else(not_the_same)?;
        let with_half = self.config.learns_at_half_size();
        let mapped = MappedKeyframe::restore(&self.gpu, &mut self.images, then, keyframe, with_half)?;
        self.keyframes.push(mapped.ok_or_else(not_the_same)?);
        Ok(())
    }
}

impl MapperState {
    /// Where the refinement stands, if it has begun.
    pub fn into_refinement(self) -> Option<FinalRefinement> {
        self.refinement
    }
}
