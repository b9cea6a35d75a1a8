//! Metrics of a finished run's folder, whichever system made it.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::SessionError;
use crate::config::Config;
use crate::evaluation::trajectory::MAX_TIME_DIFFERENCE_S;
use crate::evaluation::{Exposures, Metrics, machine, sha256_hex, write_json};
use crate::export::MapFormat;
use crate::geometry::{Se3, StampedPose, Trajectory};
use crate::gpu::Gpu;
use crate::recording::{Recording, RecordingError};
use crate::run_folder::OutputError;
use crate::run_folder::outputs::{self, Evaluation, EvaluationInput};
use crate::sequence::Sequence;
use crate::splat::GaussianCloud;

/// Values that replace those of the folder's `config.toml`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluateOptions {
    /// The recording, where the folder does not name it or it has moved.
    pub sequence: Option<PathBuf>,
    /// Resolution to compare at, as a share of the recorded one.
    pub map_scale: Option<f64>,
    /// Part of an adapter's name.
    pub adapter: Option<String>,
}

/// Measures a folder with `trajectory.txt` and a map against its recording, and writes `metrics.json`, `comparison.json` and held-out views
/// there. Figures that only the run itself knows are kept from an earlier `metrics.json`. `on_view` receives the number of compared views.
///
/// # Errors
/// If a file is missing or does not parse, the recording cannot be opened, no pose is near a frame, or a result cannot be written.
pub fn evaluate_folder(folder: &Path, options: &EvaluateOptions, on_view: &dyn Fn(usize)) -> Result<Metrics, SessionError> {
    let missing =
        |path| SessionError::Missing { path, advice: "give a run's folder, with trajectory.txt and a map, like map.ply" };
    let trajectory_file = folder.join(outputs::TRAJECTORY);
    if !trajectory_file.is_file() {
        return Err(missing(trajectory_file));
    }
    let found = outputs::find_map(folder);
    let (map_file, format) = found.ok_or_else(|| missing(folder.join(outputs::map_name(MapFormat::default()))))?;
    let recording = Recording::open(resolve(folder, options)?)?;
    let sequence = recording.sequence();
    let earlier = earlier_metrics(folder)?;
    let trajectory = read_trajectory(&trajectory_file)?;
    let keyframes_file = folder.join(outputs::KEYFRAMES);
    let keyframes = if keyframes_file.is_file() { read_trajectory(&keyframes_file)? } else { Trajectory::default() };
    let cloud = format.read(&map_file).map_err(OutputError::from)?;
    let map_bytes = std::fs::read(&map_file).map_err(|error| unreadable(&map_file, format!("cannot be read: {error}")))?;
    let poses = nearest_frames(sequence, &trajectory);
    if poses.is_empty() {
        let (trajectory, recording) = (trajectory_file, sequence.name.clone());
        return Err(SessionError::NoPoseNearFrames { trajectory, seconds: MAX_TIME_DIFFERENCE_S, recording });
    }
    let gpu = Gpu::open(recording.config().adapter.as_deref())?;
    let _lock = outputs::prepare_folder(folder)?;
    let input = EvaluationInput {
        trajectory: &trajectory,
        keyframe_indices: nearest_frames(sequence, &keyframes).into_iter().map(|(index, _)| index).collect::<BTreeSet<usize>>(),
        keyframes,
        cloud: &cloud,
        exposures: exposures(folder)?,
        poses,
    };
    let evaluation = outputs::evaluate(&recording, &gpu, &input, folder, on_view)?;
    let mut metrics = earlier.unwrap_or_else(|| foreign_metrics(&recording));
    fill(&mut metrics, evaluation, &cloud, &map_bytes);
    metrics.frames_tracked = input.poses.len() as u64;
    metrics.keyframes = (!input.keyframes.poses.is_empty()).then_some(input.keyframes.poses.len() as u64);
    metrics.adapter = Some(outputs::adapter(&gpu));
    write_json(&metrics, &folder.join(outputs::METRICS)).map_err(OutputError::from)?;
    Ok(metrics)
}

pub(super) fn resolve(folder: &Path, options: &EvaluateOptions) -> Result<Config, SessionError> {
    let own = folder.join(outputs::CONFIG);
    let mut config = if own.is_file() { Config::read(&own).map_err(RecordingError::from)? } else { Config::default() };
    if let Some(path) = &options.sequence {
        config.sequence.get_or_insert_default().path.clone_from(path);
    }
    config.map_scale = options.map_scale.unwrap_or(config.map_scale);
    config.adapter = options.adapter.clone().or(config.adapter);
    if config.sequence.is_none() {
        return Err(SessionError::UnnamedRecording { folder: folder.into() });
    }
    Ok(config)
}

fn unreadable(path: &Path, reason: impl Into<String>) -> SessionError {
    SessionError::Unreadable { path: path.into(), reason: reason.into() }
}

pub(super) fn read_trajectory(path: &Path) -> Result<Trajectory, SessionError> {
    Ok(Trajectory::read_tum(path)?)
}

/// The frame nearest in time to each pose, and the pose.
pub(super) fn nearest_frames(sequence: &Sequence, trajectory: &Trajectory) -> Vec<(usize, Se3)> {
    let nearest = |pose: &StampedPose| Some((sequence.nearest(pose.timestamp_s, MAX_TIME_DIFFERENCE_S)?, pose.world_from_camera));
    trajectory.poses.iter().filter_map(nearest).collect()
}

/// Exposures of the run, if it estimated any.
fn exposures(folder: &Path) -> Result<Exposures, SessionError> {
    let path = folder.join(outputs::EXPOSURES);
    let advice = "move it away to compare with the map's own colours";
    Exposures::read(&path).map_err(|reason| unreadable(&path, format!("{reason}; {advice}")))
}

pub(super) fn earlier_metrics(folder: &Path) -> Result<Option<Metrics>, SessionError> {
    let path = folder.join(outputs::METRICS);
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).map_err(|error| unreadable(&path, format!("cannot be read: {error}")))?;
    let advice = "move it away to have it written anew";
    serde_json::from_str(&text).map(Some).map_err(|error| unreadable(&path, format!("is not this version's ({error}); {advice}")))
}

/// Metrics of another system's run: figures that the folder does not provide stay empty.
fn foreign_metrics(recording: &Recording) -> Metrics {
    let sequence = recording.sequence();
    Metrics {
        sequence: sequence.name.clone(),
        sensor: sequence.sensor.kind(),
        paced: recording.config().replay.real_time,
        frames: sequence.entries.len() as u64,
        frames_read_failed: 0,
        frames_tracked: 0,
        frames_late: 0,
        keyframes_deferred: 0,
        keyframes: None,
        ate_rmse_m: Default::default(),
        rpe: Default::default(),
        images: Default::default(),
        gaussians: None,
        map_bytes: None,
        map_hash: None,
        wall_s: None,
        resumed: 0,
        tracking_ms: None,
        depth_bias: None,
        pixel_sigma: None,
        mapping: None,
        peak_host_bytes: None,
        peak_gpu_bytes: None,
        adapter: None,
        cpu: machine::cpu_name(),
        threads: std::thread::available_parallelism().map_or(1, |n| n.get() as u64),
        version: env!("CARGO_PKG_VERSION").into(),
        config_hash: None,
    }
}

fn fill(metrics: &mut Metrics, evaluation: Evaluation, cloud: &GaussianCloud, map_bytes: &[u8]) {
    metrics.ate_rmse_m = evaluation.ate_rmse_m;
    metrics.rpe = evaluation.rpe;
    metrics.images = evaluation.images;
    metrics.gaussians = Some(cloud.len() as u64);
    metrics.map_bytes = Some(map_bytes.len() as u64);
    metrics.map_hash = Some(sha256_hex(map_bytes));
}
