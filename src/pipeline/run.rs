//! Starts the threads of a run, joins them, and gathers their results.

use std::path::Path;
use std::sync::Arc;
use std::thread::{Builder, ScopedJoinHandle};
use std::time::Instant;

use crossbeam::channel::bounded;

use super::known_poses::{self, Scene};
use super::map_thread::{MapSummary, MapThread};
use super::progress::guarded;
use super::read_thread::{ReadSummary, ReadThread};
use super::track_thread::{TrackSummary, TrackThread};
use super::{KeptMapper, PipelineError, Progress};
use crate::gpu::Gpu;
use crate::mapping::KeyframeId;
use crate::recording::Recording;
use crate::run_folder::{Checkpointer, Elapsed, History, RunResult, image_exposures};
use crate::splat::GaussianCloud;
use crate::tracking::KeyframePose;

/// Frames decoded ahead of the tracker. In real time these are due frames that wait: a slow frame, of a keyframe say, costs none of the next.
pub(super) const FRAMES_AHEAD: usize = 8;
/// Capacity of the mapper's channel: small, so that the map never lags far behind the camera.
const MESSAGES_AHEAD: usize = 4;

/// A replay that has ended, early or not.
#[derive(Debug)]
pub struct Replay {
    /// Trajectory, map and records until the end.
    pub result: RunResult,
    /// Error that ended the run early.
    pub error: Option<PipelineError>,
    /// The mapper, where [`Control::keep_mapper`](super::Control::keep_mapper) kept it.
    pub kept: Option<KeptMapper>,
    /// Whether [`Control::stop`](super::Control::stop) ended it early.
    pub stopped: bool,
}

/// Replays a recording, from a checkpoint on if there is one. Errors that end it early are returned beside the partial result. Gaussians that leave
/// the GPU go to the file `chunks`, or to a temporary one.
///
/// # Errors
/// If there is no result at all: a thread cannot be started, or the run does not reach its checkpoint.
pub fn run(
    recording: &Recording,
    gpu: &Arc<Gpu>,
    progress: &Progress,
    checkpointer: Option<Checkpointer>,
    chunks: Option<&Path>,
) -> Result<Replay, PipelineError> {
    let started = Instant::now();
    let mut elapsed = checkpointer.as_ref().map_or_else(Elapsed::default, Checkpointer::earlier);
    let config = recording.config();
    let real_time = config.replay.real_time;
    let (frame_sender, frames) = bounded(FRAMES_AHEAD);
    let waiting = real_time.then(|| frames.clone());
    let (message_sender, messages) = bounded(MESSAGES_AHEAD);
    let scene = &config.replay.known_poses.then(|| Scene::new(recording, progress)).transpose()?;
    let mapping = &scene.as_ref().map_or_else(|| config.mapping.clone(), |scene| scene.in_units(&config.mapping));
    let (read, track, map) = std::thread::scope(|scope| {
        let spawn_error = |thread| move |source| PipelineError::Spawn { thread, source };
        // A thread that cannot start drops its end of the channels, and the others end with it.
        let map = Builder::new()
            .name("mapping".into())
            .spawn_scoped(scope, move || {
                let (messages, frames) = (&messages, waiting.as_ref());
                let thread = MapThread { gpu, config: mapping, messages, frames, progress, chunks };
                let map = thread.map(&mut |_| (), checkpointer);
                if map.error.is_some() {
                    // The others see that the channel is closed once nothing holds them.
                    progress.control().resume();
                }
                map
            })
            .map_err(spawn_error("mapping"))?;
        let track = Builder::new()
            .name("tracking".into())
            .spawn_scoped(scope, move || {
                let thread = TrackThread { recording, frames: &frames, mapper: &message_sender, progress };
                scene.as_ref().map_or_else(|| thread.track(), |scene| known_poses::follow(&thread, scene))
            })
            .map_err(spawn_error("tracking"))?;
        let read = Builder::new()
            .name("reading".into())
            .spawn_scoped(scope, move || {
                let all = || (0..recording.sequence().entries.len()).collect();
                let frames = scene.as_ref().map_or_else(all, Scene::frames);
                ReadThread::new(recording, frames, &frame_sender, progress).read()
            })
            .map_err(spawn_error("reading"))?;
        Ok::<_, PipelineError>((join("reading", read), join("tracking", track), join("mapping", map)))
    })?;
    if !matches!(&map, Ok(MapSummary { kept: Some(_), .. })) {
        progress.close_orders();
    }
    if let Ok(MapSummary { behind: true, error, .. }) = map {
        let cause = track.map_or_else(Some, |track| track.error);
        return Err(cause.or(error).expect("a run that falls behind has an error"));
    }
    elapsed.wall_s += started.elapsed().as_secs_f64();
    let mut replay = Replay { stopped: progress.stopped(), ..gather(recording, elapsed, read, track, map) };
    if let Some(scene) = scene {
        replay.result.cloud = scene.result_of(replay.result.cloud);
    }
    Ok(replay)
}

fn join<T>(thread: &'static str, handle: ScopedJoinHandle<'_, T>) -> Result<T, PipelineError> {
    guarded(thread, || Ok(handle.join().unwrap_or_else(|payload| std::panic::resume_unwind(payload))))
}

fn gather(
    recording: &Recording,
    Elapsed { wall_s, resumed }: Elapsed,
    read: Result<ReadSummary, PipelineError>,
    track: Result<TrackSummary, PipelineError>,
    map: Result<MapSummary, PipelineError>,
) -> Replay {
    let mut errors = Vec::new();
    let read = read.unwrap_or_else(|error| {
        errors.push(error);
        ReadSummary::default()
    });
    let map = map.unwrap_or_else(|error| MapSummary { error: Some(error), ..MapSummary::default() });
    let track = track.unwrap_or_else(|error| TrackSummary { error: Some(error), ..TrackSummary::default() });
    let frames = recording.sequence().entries.len();
    if let Some(first) = read.first_failure.filter(|_| read.read_failed == frames) {
        errors.push(PipelineError::NothingRead { frames, first });
    }
    let trajectory = track.stamped();
    errors.extend(track.error);
    errors.extend(map.error);
    let result = RunResult {
        cloud: writable(map.cloud),
        poses: track.trajectory,
        trajectory,
        tracking_ms: track.frames.iter().map(|frame| frame.times.total_ms()).collect(),
        history: History { frames: track.frames, keyframes: map.keyframes, loops: places(&track.loops, &track.keyframes) },
        image_exposures: image_exposures(&track.images, &map.images),
        keyframes: track.keyframes,
        frames_read_failed: read.read_failed,
        frames_late: read.late,
        keyframes_deferred: track.deferred,
        depth_bias: track.depth_bias,
        pixel_sigma: track.pixel_sigma,
        step_ms: map.step_ms,
        paging: map.paging,
        wall_s,
        resumed,
    };
    Replay { result, kept: map.kept, error: errors.into_iter().next(), stopped: false }
}

/// Loops by the places of their keyframes in the list; those of submaps that never joined are left out.
fn places(loops: &[[KeyframeId; 2]], keyframes: &[KeyframePose]) -> Vec<[usize; 2]> {
    let place = |id: &KeyframeId| keyframes.binary_search_by_key(id, |keyframe| keyframe.frame_index).ok();
    loops.iter().filter_map(|[a, b]| Some([place(a)?, place(b)?])).collect()
}

/// A map that every format can hold: Gaussians with a NaN or an infinity are left out, with a warning.
pub(super) fn writable(cloud: Arc<GaussianCloud>) -> Arc<GaussianCloud> {
    if cloud.first_non_finite().is_none() {
        return cloud;
    }
    let finite = cloud.finite();
    tracing::warn!(
        "{} of {} Gaussians are left out: they hold values that are not finite",
        cloud.len() - finite.len(),
        cloud.len()
    );
    Arc::new(finite)
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};

    use super::*;
    use crate::splat::{Gaussian, ShDegree};

    #[test]
    fn gaussians_that_are_not_finite_never_reach_a_file() {
        let mut cloud = GaussianCloud::new(ShDegree::new(1).unwrap());
        for (x, harmonic) in [(0.0, 0.0), (1.0, f32::NAN), (f32::INFINITY, 0.0), (3.0, 0.5)] {
            let (mean, sh) = (Vec3::new(x, 0.0, 1.0), vec![Vec3::ZERO, Vec3::splat(harmonic)]);
            cloud.push(Gaussian { mean, log_scale: Vec3::ZERO, rotation: Quat::IDENTITY, raw_opacity: 0.0, sh });
        }
        let cloud = writable(Arc::new(cloud));
        assert_eq!(cloud.means.iter().map(|mean| mean.x).collect::<Vec<_>>(), [0.0, 3.0]);
        assert!(Arc::ptr_eq(&cloud, &writable(cloud.clone())));
    }
}
