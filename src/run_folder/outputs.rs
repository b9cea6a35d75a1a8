//! Files of a run: trajectories, map, configuration, pictures, metrics. The least replaceable are written first.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use image::{GenericImage, RgbImage};
use serde::Serialize;

pub use super::map_file::{WrittenMap, find_map, map_name, write_map};
use super::{FolderLock, RunResult};
use crate::evaluation::metrics::{
    Adapter, AteFigures, DepthBiasFigures, ImageProtocols, MappingFigures, Metrics, RpeFigures, Times, UsualTimes,
};
use crate::evaluation::views::{ComparedView, ViewSelection, ViewSource, evaluate_views};
use crate::evaluation::{
    Alignment, Comparison, Exposures, draw_trajectory, evaluate_trajectory, machine, sha256_hex, write_json,
};
use crate::export::ExportError;
use crate::files::{WriteError, remove_partials, write_atomically, write_durably};
use crate::geometry::{Se3, Trajectory};
use crate::gpu::{Gpu, GpuError};
use crate::recording::Recording;
use crate::splat::GaussianCloud;
use crate::tracking::DepthBias;

/// Poses of all tracked frames, TUM format.
pub const TRAJECTORY: &str = "trajectory.txt";
/// Poses of the keyframes, TUM format.
pub const KEYFRAMES: &str = "keyframes.txt";
/// Accuracy, times and memory.
pub const METRICS: &str = "metrics.json";
/// The resolved configuration.
pub const CONFIG: &str = "config.toml";
/// Folder of held-out views beside their renders.
pub const VIEWS: &str = "views";
/// Estimated and true path, and the error over time.
pub const DRAWING: &str = "trajectory.svg";
/// Records of frames and keyframes.
pub const HISTORY: &str = "history.json";
/// Errors of each pose and each held-out view.
pub const COMPARISON: &str = "comparison.json";
/// Exposures of the keyframes, where they are estimated.
pub const EXPOSURES: &str = "exposures.json";
/// State to resume from; absent after the run's end.
pub const CHECKPOINT: &str = "checkpoint.bin";
/// Gaussians that have left the GPU; absent after the run's end.
pub const CHUNKS: &str = "chunks.bin";

/// At most this many held-out views are kept as pictures, spread evenly.
const MAX_PICTURES: usize = 100;

/// An output that could not be made.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The folder cannot be created.
    #[error("cannot create the output folder {path}: {source}; choose another with --out")]
    Folder {
        /// Its path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Another process holds its lock.
    #[error("another keysplat is at work in {path}; wait until it has ended, or choose another folder")]
    Busy {
        /// Its path.
        path: PathBuf,
    },
    /// An earlier file cannot be removed.
    #[error("cannot remove {path}, which is of an earlier run: {source}; choose another folder with --out")]
    Remove {
        /// Its path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The plotting library failed.
    #[error("cannot draw the trajectory: {0}; please report this")]
    Drawing(String),
    /// A picture cannot be encoded.
    #[error("cannot encode {path}: {source}")]
    Picture {
        /// Its path.
        path: PathBuf,
        /// The cause.
        source: image::ImageError,
    },
    /// The map cannot be exported.
    #[error(transparent)]
    Export(#[from] ExportError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The adapter failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

/// Creates the folder, locks it for this process, and verifies that it is writable.
///
/// # Errors
/// If it cannot be created or written to, or another process holds it.
pub fn prepare_folder(out: &Path) -> Result<FolderLock, OutputError> {
    let probe = out.join(".writable");
    let folder_error = |source| OutputError::Folder { path: out.into(), source };
    std::fs::create_dir_all(out.join(VIEWS)).map_err(folder_error)?;
    let lock = FolderLock::take(out)?;
    [out, &out.join(VIEWS)].into_iter().for_each(remove_partials);
    std::fs::write(&probe, b"").and_then(|()| std::fs::remove_file(&probe)).map_err(folder_error)?;
    Ok(lock)
}

/// Removes the checkpoint of a finished run.
///
/// # Errors
/// If it exists and cannot be removed.
pub fn remove_checkpoint(out: &Path) -> Result<(), OutputError> {
    remove_file(&out.join(CHECKPOINT))
}

pub(super) fn remove_file(path: &Path) -> Result<(), OutputError> {
    match std::fs::remove_file(path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(OutputError::Remove { path: path.into(), source }),
        _ => Ok(()),
    }
}

/// Removes an earlier run's pictures, and nothing else that may lie beside them.
fn remove_pictures(out: &Path) -> Result<(), OutputError> {
    let Ok(entries) = std::fs::read_dir(out.join(VIEWS)) else { return Ok(()) };
    let is_ours = |name: &str| name.strip_suffix(".png").is_some_and(|n| n.len() >= 6 && n.bytes().all(|b| b.is_ascii_digit()));
    for entry in entries.filter_map(Result::ok).filter(|entry| entry.file_name().to_str().is_some_and(is_ours)) {
        remove_file(&entry.path())?;
    }
    Ok(())
}

/// Writes trajectories, map, records and the resolved configuration, and flushes them to the disk: the checkpoint may go then. Metrics of an
/// earlier run in the same folder are removed first: they
/// would belong to another map.
///
/// # Errors
/// If a file cannot be written, or the map holds a value that is not finite.
pub fn write_results(out: &Path, recording: &Recording, result: &RunResult) -> Result<WrittenMap, OutputError> {
    remove_file(&out.join(METRICS))?;
    write_durably(&out.join(TRAJECTORY), result.trajectory.to_tum().as_bytes())?;
    write_durably(&out.join(KEYFRAMES), result.keyframe_trajectory().to_tum().as_bytes())?;
    write_durably(&out.join(CONFIG), recording.config().to_toml().as_bytes())?;
    write_records(&out.join(HISTORY), &result.history)?;
    remove_file(&out.join(EXPOSURES))?;
    if recording.config().mapping.exposure.enabled {
        write_records(&out.join(EXPOSURES), &result.exposures())?;
    }
    let poses: Vec<Se3> = result.keyframes.iter().map(|keyframe| keyframe.world_from_camera).collect();
    write_map(out, recording.config().map_format, &result.cloud, &poses)
}

/// Errors of a trajectory and a map against their recording.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// Absolute trajectory error, metres.
    pub ate_rmse_m: AteFigures,
    /// Relative pose error per frame.
    pub rpe: RpeFigures,
    /// Image errors by each protocol.
    pub images: ImageProtocols,
}

/// A trajectory and a map to be evaluated, of any system.
#[derive(Clone, Debug)]
pub struct EvaluationInput<'a> {
    /// Poses of all tracked frames.
    pub trajectory: &'a Trajectory,
    /// Frame indices and `world_from_camera` of the same poses.
    pub poses: Vec<(usize, Se3)>,
    /// Poses of the keyframes.
    pub keyframes: Trajectory,
    /// Frame indices of the keyframes.
    pub keyframe_indices: BTreeSet<usize>,
    /// The map.
    pub cloud: &'a GaussianCloud,
    /// Exposures of the keyframes; empty where they are not estimated.
    pub exposures: Exposures,
}

impl<'a> From<&'a RunResult> for EvaluationInput<'a> {
    fn from(result: &'a RunResult) -> Self {
        Self {
            trajectory: &result.trajectory,
            poses: result.frame_poses(),
            keyframes: result.keyframe_trajectory(),
            keyframe_indices: result.keyframe_indices(),
            cloud: &result.cloud,
            exposures: result.exposures(),
        }
    }
}

/// Measures trajectory and images, and writes held-out views beside their renders. `on_view` receives the number of views done.
///
/// # Errors
/// If the adapter fails or a file cannot be written.
pub fn evaluate(
    recording: &Recording,
    gpu: &Arc<Gpu>,
    input: &EvaluationInput<'_>,
    out: &Path,
    on_view: &dyn Fn(usize),
) -> Result<Evaluation, OutputError> {
    let (sequence, config) = (recording.sequence(), recording.config());
    remove_pictures(out)?;
    let truth = sequence.groundtruth.as_ref();
    let alignment = Alignment::of(sequence.sensor.kind());
    let errors = |estimate: &Trajectory| truth.and_then(|truth| evaluate_trajectory(truth, estimate, alignment).ok());
    let (all, keyframes) = (errors(input.trajectory), errors(&input.keyframes));
    remove_file(&out.join(DRAWING))?;
    if let (Some(truth), Some(errors)) = (truth, &all) {
        let svg = draw_trajectory(truth, input.trajectory, errors).map_err(OutputError::Drawing)?;
        write_atomically(&out.join(DRAWING), svg.as_bytes())?;
    }
    let mut comparison = Comparison::of(input.trajectory, truth.zip(all.as_ref()));
    let is_held_out = |index: usize| config.replay.is_held_out(index);
    let held_out = input.poses.iter().map(|(index, _)| *index).filter(|index| is_held_out(*index)).collect::<Vec<_>>();
    let pictures = Pictures::new(out, &held_out);
    let selection = ViewSelection {
        poses: &input.poses,
        keyframes: &input.keyframe_indices,
        is_held_out: &is_held_out,
        exposures: &input.exposures,
    };
    let (cloud, map_scale, surface) = (input.cloud, config.map_scale, config.mapping.surface);
    let most_gaussians = config.mapping.limits.most_rendered(gpu.bytes(), cloud.sh_degree);
    let source = ViewSource { sequence, map_scale, gpu, cloud, most_gaussians, surface };
    let (images, views) = evaluate_views(source, &selection, &|view| pictures.add(view), on_view)?;
    comparison.views = views;
    pictures.finish()?;
    write_records(&out.join(COMPARISON), &comparison)?;
    Ok(Evaluation {
        ate_rmse_m: AteFigures {
            all_frames: all.as_ref().map(|e| e.ate_rmse_m),
            keyframes: keyframes.as_ref().map(|e| e.ate_rmse_m),
        },
        rpe: RpeFigures {
            trans_m_per_frame: all.as_ref().map(|e| e.rpe.trans_m_per_frame),
            rot_deg_per_frame: all.as_ref().map(|e| e.rpe.rot_deg_per_frame),
        },
        images,
    })
}

/// Pictures of at most [`MAX_PICTURES`] held-out views, spread evenly. None is begun after one has failed.
struct Pictures<'a> {
    out: &'a Path,
    frames: BTreeSet<usize>,
    error: OnceLock<OutputError>,
}

impl<'a> Pictures<'a> {
    fn new(out: &'a Path, held_out: &[usize]) -> Self {
        let every = held_out.len().div_ceil(MAX_PICTURES).max(1);
        Self { out, frames: held_out.iter().step_by(every).copied().collect(), error: OnceLock::new() }
    }

    fn add(&self, view: &ComparedView) {
        if self.error.get().is_none()
            && self.frames.contains(&view.figures.frame)
            && let Err(error) = write_picture(self.out, view)
        {
            // Of several that fail at once, the first is reported.
            let _ = self.error.set(error);
        }
    }

    fn finish(self) -> Result<(), OutputError> {
        self.error.into_inner().map_or(Ok(()), Err)
    }
}

/// File name of a held-out view in [`VIEWS`].
pub fn picture_name(frame: usize) -> String {
    format!("{frame:06}.png")
}

fn write_records(path: &Path, records: &impl Serialize) -> Result<(), WriteError> {
    let text = serde_json::to_string(records).expect("records are numbers, which JSON can hold");
    write_durably(path, text.as_bytes())
}

/// Recorded left, rendered right.
fn write_picture(out: &Path, view: &ComparedView) -> Result<(), OutputError> {
    let path = out.join(VIEWS).join(picture_name(view.figures.frame));
    let picture_error = |source| OutputError::Picture { path: path.clone(), source };
    let (width, height) = view.recorded.dimensions();
    let mut pair = RgbImage::new(2 * width, height);
    pair.copy_from(&view.recorded, 0, 0).map_err(picture_error)?;
    pair.copy_from(&view.rendered, width, 0).map_err(picture_error)?;
    let mut png = std::io::Cursor::new(Vec::new());
    pair.write_to(&mut png, image::ImageFormat::Png).map_err(picture_error)?;
    Ok(write_atomically(&path, png.get_ref())?)
}

/// Assembles all figures of a run and writes `metrics.json`.
///
/// # Errors
/// If the file cannot be written.
pub fn write_metrics(
    out: &Path,
    recording: &Recording,
    gpu: &Gpu,
    result: &RunResult,
    map: &WrittenMap,
    evaluation: Evaluation,
) -> Result<Metrics, OutputError> {
    let (sequence, config) = (recording.sequence(), recording.config());
    let frames = sequence.entries.len() as u64;
    let iterations = result.step_ms.len() as u64;
    let pinhole = recording.map_pinhole();
    let metrics = Metrics {
        sequence: sequence.name.clone(),
        sensor: sequence.sensor.kind(),
        paced: config.replay.real_time,
        frames,
        frames_read_failed: result.frames_read_failed as u64,
        frames_tracked: result.poses.len() as u64,
        frames_late: result.frames_late as u64,
        keyframes_deferred: result.keyframes_deferred as u64,
        keyframes: Some(result.keyframes.len() as u64),
        ate_rmse_m: evaluation.ate_rmse_m,
        rpe: evaluation.rpe,
        images: evaluation.images,
        gaussians: Some(result.cloud.len() as u64),
        map_bytes: Some(map.bytes),
        map_hash: Some(map.hash.clone()),
        wall_s: Some(result.wall_s),
        resumed: result.resumed,
        tracking_ms: Times::of(&result.tracking_ms),
        pixel_sigma: result.pixel_sigma,
        depth_bias: result.depth_bias.map(|DepthBias(bias)| DepthBiasFigures {
            offset_per_m: bias.x,
            tilt_x_per_m: bias.y,
            tilt_y_per_m: bias.z,
        }),
        mapping: Some(MappingFigures {
            iterations,
            iterations_per_frame: iterations as f64 / frames.max(1) as f64,
            ms_per_iteration: UsualTimes::of(&result.step_ms),
            map_width: pinhole.width,
            map_height: pinhole.height,
            paging: result.paging_figures(),
        }),
        peak_host_bytes: machine::peak_host_bytes(),
        peak_gpu_bytes: Some(gpu.peak_bytes()),
        adapter: Some(adapter(gpu)),
        cpu: machine::cpu_name(),
        threads: std::thread::available_parallelism().map_or(1, |n| n.get() as u64),
        version: env!("CARGO_PKG_VERSION").into(),
        config_hash: Some(sha256_hex(config.identity().as_bytes())),
    };
    write_json(&metrics, &out.join(METRICS))?;
    Ok(metrics)
}

/// The adapter as metrics name it.
pub fn adapter(gpu: &Gpu) -> Adapter {
    let a = gpu.adapter.clone();
    Adapter { name: a.name, backend: a.backend, kind: a.kind, driver: a.driver }
}

#[cfg(test)]
mod tests;
