//! A log of the tracker's messages: mappers with different settings are compared on the same keyframes and poses, without tracking again.

use std::sync::Arc;
use std::thread::Builder;
use std::time::{Duration, Instant};

use crossbeam::channel::{bounded, unbounded};

use super::known_poses::{self, Scene};
use super::map_thread::{MapSummary, MapThread};
use super::read_thread::ReadThread;
use super::refining::Round;
use super::run::FRAMES_AHEAD;
use super::track_thread::TrackThread;
use super::{PipelineError, Progress};
use crate::evaluation::Exposures;
use crate::geometry::Se3;
use crate::gpu::Gpu;
use crate::mapping::{MapperMessage, MappingConfig};
use crate::recording::Recording;
use crate::run_folder::{exposures, image_exposures};
use crate::splat::GaussianCloud;
use crate::tracking::KeyframePose;

/// Messages of a tracked recording.
#[derive(Debug)]
pub struct TrackedLog<'a> {
    /// Where poses are known.
    scene: Option<Scene<'a>>,
    /// In the order in which deterministic replay sends them.
    messages: Vec<MapperMessage>,
    poses: Vec<(usize, Se3)>,
    keyframes: Vec<KeyframePose>,
    images: Vec<KeyframePose>,
}

/// A map made from a log.
#[derive(Clone, Debug)]
pub struct MappedLog {
    /// The map.
    pub cloud: Arc<GaussianCloud>,
    /// Exposures of the keyframes; empty before the last round.
    pub exposures: Exposures,
    /// Time of the mapper alone, seconds.
    pub wall_s: f64,
    /// Optimisation steps.
    pub steps: usize,
}

impl<'a> TrackedLog<'a> {
    /// Tracks a recording deterministically and stores the messages to the mapper.
    ///
    /// # Errors
    /// The error that ended tracking early.
    pub fn record(recording: &'a Recording, progress: &Progress) -> Result<Self, PipelineError> {
        let scene = recording.config().replay.known_poses.then(|| Scene::new(recording, progress)).transpose()?;
        let (frame_sender, frames) = bounded(FRAMES_AHEAD);
        let (message_sender, messages) = unbounded();
        let track = std::thread::scope(|scope| {
            // Dropped before the scope joins the reader, which would block on a full channel otherwise.
            let frames = frames;
            Builder::new()
                .name("reading".into())
                .spawn_scoped(scope, move || {
                    let frames = (0..recording.sequence().entries.len()).collect();
                    ReadThread::new(recording, frames, &frame_sender, progress).read()
                })
                .map_err(|source| PipelineError::Spawn { thread: "reading", source })?;
            let thread = TrackThread { recording, frames: &frames, mapper: &message_sender, progress };
            Ok::<_, PipelineError>(scene.as_ref().map_or_else(|| thread.track(), |scene| known_poses::follow(&thread, scene)))
        })?;
        drop(message_sender);
        if let Some(error) = track.error {
            return Err(error);
        }
        let poses = track.trajectory.iter().map(|(index, pose)| (*index, pose.world_from_camera)).collect();
        Ok(Self { scene, messages: messages.into_iter().collect(), poses, keyframes: track.keyframes, images: track.images })
    }

    /// Frame index and `world_from_camera` of every tracked frame.
    pub fn poses(&self) -> &[(usize, Se3)] {
        &self.poses
    }

    /// Maps the log from its beginning. `on_round` receives the map after each round of the final refinement; its own time is not counted.
    ///
    /// # Errors
    /// The error that ended mapping early.
    pub fn map(
        &self,
        gpu: &Arc<Gpu>,
        config: &MappingConfig,
        progress: &Progress,
        on_round: &mut dyn FnMut(MappedLog),
    ) -> Result<MappedLog, PipelineError> {
        let (sender, messages) = unbounded();
        self.messages.iter().for_each(|message| sender.send(message.clone()).expect("the receiver is here"));
        drop(sender);
        let started = Instant::now();
        let mut paused = Duration::ZERO;
        let mut on_round = |mut round: Round<'_>| {
            let reached = Instant::now();
            let wall_s = (started.elapsed() - paused).as_secs_f64();
            if let Some(cloud) = round.cloud() {
                on_round(MappedLog { cloud, exposures: Exposures::default(), wall_s, steps: round.steps });
            }
            paused += reached.elapsed();
        };
        let config = &self.scene.as_ref().map_or_else(|| config.clone(), |scene| scene.in_units(config));
        let summary =
            MapThread { gpu, config, messages: &messages, frames: None, progress, chunks: None }.map(&mut on_round, None);
        let MapSummary { cloud, keyframes, images, step_ms, error, .. } = summary;
        let exposures = exposures(&self.keyframes, &keyframes, &image_exposures(&self.images, &images));
        let mapped = MappedLog { cloud, exposures, wall_s: (started.elapsed() - paused).as_secs_f64(), steps: step_ms.len() };
        error.map_or(Ok(mapped), Err)
    }
}
