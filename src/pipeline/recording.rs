//! What the tracker tells the mapper, kept: mappers with different settings can then be compared on exactly the same keyframes and poses,
//! without tracking beside them.

use std::sync::Arc;
use std::thread::Builder;
use std::time::{Duration, Instant};

use crossbeam::channel::{bounded, unbounded};

use super::map_thread::{self, MapSummary, Round};
use super::measurements::{Listener, Teller};
use super::run::{FRAMES_AHEAD, exposures};
use super::{MapperMessage, PipelineError, Progress, known_poses, read_thread, track_thread};
use crate::config::Config;
use crate::evaluation::Exposures;
use crate::geometry::Se3;
use crate::gpu::Gpu;
use crate::mapping::MappingConfig;
use crate::sequence::Sequence;
use crate::splat::GaussianCloud;
use crate::tracking::KeyframePose;

/// A tracked sequence.
#[derive(Clone, Debug)]
pub struct Recording {
    /// In the order in which an unpaced replay sends them.
    pub messages: Vec<MapperMessage>,
    /// `(frame index, world_from_camera)` of every tracked frame.
    pub poses: Vec<(usize, Se3)>,
    keyframes: Vec<KeyframePose>,
    /// Units of its world to a metre as the mapper's lengths mean it.
    units_per_metre: f64,
}

/// What a mapper made of a recording.
#[derive(Debug)]
pub struct Mapped {
    pub cloud: Arc<GaussianCloud>,
    pub exposures: Exposures,
    /// Time of the mapper alone.
    pub wall_s: f64,
    pub steps: usize,
}

/// Tracks a sequence unpaced and keeps what the mapper would have been told.
///
/// # Errors
/// What ended tracking early.
pub fn record(sequence: &Sequence, config: &Config, progress: &Progress) -> Result<Recording, PipelineError> {
    let (frame_sender, frames) = bounded(FRAMES_AHEAD);
    let (message_sender, messages) = unbounded();
    let known_poses = config.replay.known_poses;
    let units_per_metre = if known_poses { known_poses::units_per_metre(sequence) } else { 1.0 };
    let track = std::thread::scope(|scope| {
        Builder::new()
            .name("reading".into())
            .spawn_scoped(scope, move || read_thread::read(sequence, false, &frame_sender, progress))
            .map_err(|source| PipelineError::Spawn { thread: "reading", source })?;
        Ok::<_, PipelineError>(if known_poses {
            known_poses::follow(sequence, config, &frames, &message_sender, progress)
        } else {
            track_thread::track(sequence, config, &frames, &message_sender, Listener::default(), progress)
        })
    })?;
    drop(message_sender);
    if let Some(error) = track.error {
        return Err(error);
    }
    let poses = track.trajectory.iter().map(|(index, pose)| (*index, pose.world_from_camera)).collect();
    Ok(Recording { messages: messages.into_iter().collect(), poses, keyframes: track.keyframes, units_per_metre })
}

impl Recording {
    /// Maps the recording from its beginning. `on_round` hears what there is after each round of a refinement; the time that it takes is
    /// not counted.
    ///
    /// # Errors
    /// What ended mapping early.
    pub fn map(
        &self,
        gpu: &Arc<Gpu>,
        config: &MappingConfig,
        progress: &Progress,
        on_round: &mut dyn FnMut(Mapped),
    ) -> Result<Mapped, PipelineError> {
        let (sender, messages) = unbounded();
        self.messages.iter().for_each(|message| sender.send(message.clone()).expect("the receiver is here"));
        drop(sender);
        let started = Instant::now();
        let mut paused = Duration::ZERO;
        let mut on_round = |round: Round<'_>| {
            let reached = Instant::now();
            let wall_s = (started.elapsed() - paused).as_secs_f64();
            on_round(Mapped { cloud: round.cloud.clone(), exposures: Exposures::default(), wall_s, steps: round.steps });
            paused += reached.elapsed();
        };
        let config = config.in_units(self.units_per_metre as f32);
        let summary = map_thread::map(gpu, &config, (&messages, None), &Teller::default(), (progress, &mut on_round), None);
        let MapSummary { cloud, keyframes, step_ms, error, .. } = summary;
        let exposures = exposures(&self.keyframes, &keyframes);
        let mapped = Mapped { cloud, exposures, wall_s: (started.elapsed() - paused).as_secs_f64(), steps: step_ms.len() };
        error.map_or(Ok(mapped), Err)
    }
}
