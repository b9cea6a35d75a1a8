//! Starts the threads, waits for them, and gathers what they made.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::thread::{Builder, ScopedJoinHandle};
use std::time::Instant;

use crossbeam::channel::bounded;

use super::checkpoint::Parts;
use super::known_poses;
use super::map_thread::{self, MapSummary};
use super::measurements;
use super::messages::guarded;
use super::read_thread::{self, ReadSummary};
use super::track_thread::{self, TrackSummary};
use super::{Checkpoints, History, KeyframeRecord, PipelineError, Progress};
use crate::config::Config;
use crate::evaluation::image::WINDOW as SSIM_WINDOW;
use crate::evaluation::{ExposureRecord, Exposures};
use crate::geometry::{StampedPose, Trajectory};
use crate::gpu::Gpu;
use crate::sequence::{Sensor, Sequence};
use crate::splat::GaussianCloud;
use crate::tracking::KeyframePose;

/// Frames decoded ahead of the tracker; in paced replay those that are due and wait: the tracker may take long for one, a keyframe say, and
/// catches up in the next ones.
pub(super) const FRAMES_AHEAD: usize = 8;
/// Keyframes and pose updates that may wait for the mapper. Few, so that the map never lags far behind the camera.
const MESSAGES_AHEAD: usize = 4;

/// Everything that a replay made, whether or not it came to its end.
#[derive(Debug)]
pub struct Outcome {
    pub cloud: Arc<GaussianCloud>,
    /// `(frame index, pose)` of every tracked frame.
    pub poses: Vec<(usize, StampedPose)>,
    pub trajectory: Trajectory,
    pub keyframes: Vec<KeyframePose>,
    pub history: History,
    pub frames_read_failed: usize,
    pub frames_late: usize,
    pub keyframes_deferred: usize,
    pub tracking_ms: Vec<f64>,
    pub step_ms: Vec<f64>,
    /// All parts of a run that was resumed, as far as they came to a checkpoint.
    pub wall_s: f64,
    /// How often it went on from a checkpoint.
    pub resumed: u64,
    /// What ended the replay early.
    pub error: Option<PipelineError>,
}

impl Outcome {
    pub fn keyframe_trajectory(&self) -> Trajectory {
        Trajectory { poses: self.keyframes.iter().map(KeyframePose::stamped).collect() }
    }

    /// What the mapper found of the keyframes' exposures.
    pub fn exposures(&self) -> Exposures {
        exposures(&self.keyframes, &self.history.keyframes)
    }
}

/// Exposures of mapped keyframes, at their times.
pub(super) fn exposures(tracked: &[KeyframePose], mapped: &[KeyframeRecord]) -> Exposures {
    let times: BTreeMap<usize, f64> = tracked.iter().map(|k| (k.id, k.timestamp_s)).collect();
    let record = |KeyframeRecord { report, .. }: &KeyframeRecord| {
        Some(ExposureRecord { timestamp_s: *times.get(&report.id)?, log_gain: report.exposure })
    };
    Exposures::new(mapped.iter().filter_map(record).collect())
}

/// Says before any work whether a map could be started from this sequence.
pub fn check_first_depth(sequence: &Sequence) -> Result<(), PipelineError> {
    match sequence.entries.first() {
        Some(first) if sequence.sensor == Sensor::Rgbd && first.depth.is_none() => {
            Err(PipelineError::NoFirstDepth { color: first.color.clone() })
        }
        _ => Ok(()),
    }
}

/// Says before any work whether images at the mapping resolution are large enough to be compared.
pub fn check_size(sequence: &Sequence, map_scale: f64) -> Result<(), PipelineError> {
    let pinhole = sequence.camera.pinhole.scaled(map_scale);
    let (width, height, least) = (pinhole.width, pinhole.height, SSIM_WINDOW as u32);
    if width.min(height) < least { Err(PipelineError::TooSmall { width, height, least }) } else { Ok(()) }
}

/// Replays a sequence, from a checkpoint on if there is one. Errors that end it early are in the outcome, beside what was made until then.
///
/// # Errors
/// If there is nothing for an outcome: threads that cannot be started, a checkpoint that the run does not come up to.
pub fn run(
    sequence: &Sequence,
    gpu: &Arc<Gpu>,
    config: &Config,
    progress: &Progress,
    checkpoints: Option<Checkpoints>,
) -> Result<Outcome, PipelineError> {
    let started = Instant::now();
    let mut parts = checkpoints.as_ref().map_or_else(Parts::default, Checkpoints::earlier);
    let paced = config.replay.paced;
    let (frame_sender, frames) = bounded(FRAMES_AHEAD);
    let waiting = paced.then(|| frames.clone());
    let (message_sender, messages) = bounded(MESSAGES_AHEAD);
    let (teller, listener) = measurements::channel(config);
    let mapping = &known_poses::mapping_config(sequence, config);
    let (read, track, map) = std::thread::scope(|scope| {
        let spawn_error = |thread| move |source| PipelineError::Spawn { thread, source };
        // A thread that cannot start drops its end of the channels, and the others end with it.
        let map = Builder::new()
            .name("mapping".into())
            .spawn_scoped(scope, move || {
                map_thread::map(gpu, mapping, (&messages, waiting.as_ref()), &teller, (progress, &mut |_| ()), checkpoints)
            })
            .map_err(spawn_error("mapping"))?;
        let track = Builder::new()
            .name("tracking".into())
            .spawn_scoped(scope, move || {
                if config.replay.known_poses {
                    known_poses::follow(sequence, config, &frames, &message_sender, progress)
                } else {
                    track_thread::track(sequence, config, &frames, &message_sender, listener, progress)
                }
            })
            .map_err(spawn_error("tracking"))?;
        let read = Builder::new()
            .name("reading".into())
            .spawn_scoped(scope, move || read_thread::read(sequence, paced, &frame_sender, progress))
            .map_err(spawn_error("reading"))?;
        Ok::<_, PipelineError>((join("reading", read), join("tracking", track), join("mapping", map)))
    })?;
    if let Ok(MapSummary { behind: true, error, .. }) = map {
        let cause = track.map_or_else(Some, |track| track.error);
        return Err(cause.or(error).expect("who falls behind says why"));
    }
    parts.wall_s += started.elapsed().as_secs_f64();
    Ok(outcome(sequence, parts, read, track, map))
}

fn join<T>(thread: &'static str, handle: ScopedJoinHandle<'_, T>) -> Result<T, PipelineError> {
    guarded(thread, || Ok(handle.join().unwrap_or_else(|payload| std::panic::resume_unwind(payload))))
}

fn outcome(
    sequence: &Sequence,
    Parts { wall_s, resumed }: Parts,
    read: Result<ReadSummary, PipelineError>,
    track: Result<TrackSummary, PipelineError>,
    map: Result<MapSummary, PipelineError>,
) -> Outcome {
    let mut errors = Vec::new();
    let read = read.unwrap_or_else(|error| {
        errors.push(error);
        ReadSummary::default()
    });
    let map = map.unwrap_or_else(|error| MapSummary { error: Some(error), ..MapSummary::default() });
    let track = track.unwrap_or_else(|error| TrackSummary { error: Some(error), ..TrackSummary::default() });
    let frames = sequence.entries.len();
    if let Some(first) = read.first_failure.filter(|_| read.read_failed == frames) {
        errors.push(PipelineError::NothingRead { frames, first });
    }
    let trajectory = track.stamped();
    errors.extend(track.error);
    errors.extend(map.error);
    Outcome {
        cloud: map.cloud,
        poses: track.trajectory,
        trajectory,
        keyframes: track.keyframes,
        tracking_ms: track.frames.iter().map(|frame| frame.times.total_ms()).collect(),
        history: History { frames: track.frames, keyframes: map.keyframes },
        frames_read_failed: read.read_failed,
        frames_late: read.late,
        keyframes_deferred: track.deferred,
        step_ms: map.step_ms,
        wall_s,
        resumed,
        error: errors.into_iter().next(),
    }
}
