//! What the tracker tells the mapper, kept: mappers with different settings can then be compared on exactly the same keyframes and poses,
//! without tracking beside them.

use std::sync::Arc;
use std::thread::Builder;
use std::time::Instant;

use crossbeam::channel::{bounded, unbounded};

use super::map_thread::{self, MapSummary};
use super::measurements::{Listener, Teller};
use super::{MapperMessage, PipelineError, Progress, read_thread, track_thread};
use crate::config::Config;
use crate::geometry::Se3;
use crate::gpu::Gpu;
use crate::mapping::MappingConfig;
use crate::sequence::Sequence;
use crate::splat::GaussianCloud;

const FRAMES_AHEAD: usize = 4;

/// A tracked sequence.
#[derive(Clone, Debug)]
pub struct Recording {
    /// In the order in which an unpaced replay sends them.
    pub messages: Vec<MapperMessage>,
    /// `(frame index, world_from_camera)` of every tracked frame.
    pub poses: Vec<(usize, Se3)>,
}

/// What a mapper made of a recording.
#[derive(Debug)]
pub struct Mapped {
    pub cloud: Arc<GaussianCloud>,
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
    let track = std::thread::scope(|scope| {
        Builder::new()
            .name("reading".into())
            .spawn_scoped(scope, move || read_thread::read(sequence, false, &frame_sender, progress))
            .map_err(|source| PipelineError::Spawn { thread: "reading", source })?;
        Ok::<_, PipelineError>(track_thread::track(sequence, config, &frames, &message_sender, Listener::default(), progress))
    })?;
    drop(message_sender);
    if let Some(error) = track.error {
        return Err(error);
    }
    let poses = track.trajectory.iter().map(|(index, pose)| (*index, pose.world_from_camera)).collect();
    Ok(Recording { messages: messages.into_iter().collect(), poses })
}

impl Recording {
    /// Maps the recording from its beginning.
    ///
    /// # Errors
    /// What ended mapping early.
    pub fn map(&self, gpu: &Arc<Gpu>, config: &MappingConfig, progress: &Progress) -> Result<Mapped, PipelineError> {
        let (sender, messages) = unbounded();
        self.messages.iter().for_each(|message| sender.send(message.clone()).expect("the receiver is here"));
        drop(sender);
        let started = Instant::now();
        let MapSummary { cloud, step_ms, error, .. } = map_thread::map(gpu, config, &messages, &Teller::default(), progress);
        let mapped = Mapped { cloud, wall_s: started.elapsed().as_secs_f64(), steps: step_ms.len() };
        error.map_or(Ok(mapped), Err)
    }
}
