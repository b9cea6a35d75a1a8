//! The run's folder: trajectories, map, configuration, pictures, figures. What can be lost least is written first.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{GenericImage, RgbImage};
use serde::Serialize;

use super::{FolderLock, Outcome};
use crate::config::Config;
use crate::evaluation::metrics::{Adapter, AteFigures, MappingFigures, Metrics, RpeFigures, Times, UsualTimes};
use crate::evaluation::views::{ComparedView, ViewSelection, evaluate_views};
use crate::evaluation::{
    Alignment, Comparison, Exposures, draw_trajectory, evaluate_trajectory, machine, sha256_hex, write_json,
};
use crate::export::{ExportError, MapFormat, remove_partials, write_atomically};
use crate::geometry::{Se3, Trajectory};
use crate::gpu::{Gpu, GpuError};
use crate::sequence::{SensorKind, Sequence};
use crate::splat::GaussianCloud;

/// Names in the run's folder.
pub const TRAJECTORY: &str = "trajectory.txt";
pub const KEYFRAMES: &str = "keyframes.txt";
pub const MAP: &str = "map.ply";
pub const METRICS: &str = "metrics.json";
pub const CONFIG: &str = "config.toml";
pub const VIEWS: &str = "views";
pub const DRAWING: &str = "trajectory.svg";
pub const HISTORY: &str = "history.json";
pub const COMPARISON: &str = "comparison.json";
/// Of the keyframes, if exposures are corrected.
pub const EXPOSURES: &str = "exposures.json";
/// Until the run is finished, and if it keeps any.
pub const CHECKPOINT: &str = "checkpoint.bin";

/// At most this many held-out views are kept as pictures, spread evenly.
const MAX_PICTURES: usize = 100;

#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    #[error("cannot create the output folder {path}: {source}; choose another with --out")]
    Folder { path: PathBuf, source: std::io::Error },
    #[error("another keysplat is at work in {path}; wait until it has ended, or choose another folder")]
    Busy { path: PathBuf },
    #[error("cannot remove {path}, which is of an earlier run: {source}; choose another folder with --out")]
    Remove { path: PathBuf, source: std::io::Error },
    #[error("cannot draw the trajectory: {0}; please report this")]
    Drawing(String),
    #[error("cannot encode {path}: {source}")]
    Picture { path: PathBuf, source: image::ImageError },
    #[error(transparent)]
    Export(#[from] ExportError),
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

/// Creates the folder, takes it for this process alone, and checks that it can be written to, before any work starts.
pub fn prepare_folder(out: &Path) -> Result<FolderLock, OutputError> {
    let probe = out.join(".writable");
    let folder_error = |source| OutputError::Folder { path: out.into(), source };
    std::fs::create_dir_all(out.join(VIEWS)).map_err(folder_error)?;
    let lock = FolderLock::take(out)?;
    remove_partials(out);
    std::fs::write(&probe, b"").and_then(|()| std::fs::remove_file(&probe)).map_err(folder_error)?;
    Ok(lock)
}

/// Removes the checkpoint of a run that is finished.
pub fn remove_checkpoint(out: &Path) -> Result<(), OutputError> {
    remove_file(&out.join(CHECKPOINT))
}

fn remove_file(path: &Path) -> Result<(), OutputError> {
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

/// Size and hash of a written map.
#[derive(Clone, Debug)]
pub struct WrittenMap {
    pub bytes: u64,
    pub hash: String,
}

/// Writes what the replay made: trajectories, map, and the configuration that made them. Figures of an earlier run in the same
/// folder go first: they would belong to another map.
pub fn write_results(out: &Path, outcome: &Outcome, config: &Config) -> Result<WrittenMap, OutputError> {
    remove_file(&out.join(METRICS))?;
    write_atomically(&out.join(TRAJECTORY), outcome.trajectory.to_tum().as_bytes())?;
    write_atomically(&out.join(KEYFRAMES), outcome.keyframe_trajectory().to_tum().as_bytes())?;
    write_atomically(&out.join(CONFIG), config.to_toml().as_bytes())?;
    write_records(&out.join(HISTORY), &outcome.history)?;
    remove_file(&out.join(EXPOSURES))?;
    if config.mapping.exposure.enabled {
        write_records(&out.join(EXPOSURES), &outcome.exposures())?;
    }
    let bytes = MapFormat::Ply.write(&outcome.cloud, &out.join(MAP))?;
    Ok(WrittenMap { bytes: bytes.len() as u64, hash: sha256_hex(&bytes) })
}

/// What is measured against the recording, of a run of ours or anybody's.
pub struct Measured {
    pub ate_rmse_m: AteFigures,
    pub rpe: RpeFigures,
    pub images: crate::evaluation::metrics::ImageProtocols,
}

/// A trajectory and a map to be measured.
pub struct Subject<'a> {
    pub trajectory: &'a Trajectory,
    /// Frame indices and poses of the same trajectory.
    pub poses: Vec<(usize, Se3)>,
    pub keyframes: Trajectory,
    pub keyframe_indices: BTreeSet<usize>,
    pub cloud: &'a GaussianCloud,
    pub exposures: Exposures,
}

/// Measures trajectory and images, and writes the held-out views beside their renders. `progress` hears how many views are done.
pub fn measure(
    (sequence, config): (&Sequence, &Config),
    gpu: &Arc<Gpu>,
    subject: &Subject<'_>,
    out: &Path,
    progress: &dyn Fn(usize),
) -> Result<Measured, OutputError> {
    remove_pictures(out)?;
    let truth = sequence.groundtruth.as_ref();
    // One camera alone cannot know the scale.
    let alignment = if sequence.sensor.kind() == SensorKind::Mono { Alignment::Similarity } else { Alignment::Rigid };
    let errors = |estimate: &Trajectory| truth.and_then(|truth| evaluate_trajectory(truth, estimate, alignment).ok());
    let (all, keyframes) = (errors(subject.trajectory), errors(&subject.keyframes));
    remove_file(&out.join(DRAWING))?;
    if let (Some(truth), Some(errors)) = (truth, &all) {
        let svg = draw_trajectory(truth, subject.trajectory, errors).map_err(OutputError::Drawing)?;
        write_atomically(&out.join(DRAWING), svg.as_bytes())?;
    }
    let mut comparison = Comparison::of(subject.trajectory, truth.zip(all.as_ref()));
    let is_held_out = |index: usize| config.replay.is_held_out(index);
    let held_out = subject.poses.iter().filter(|(index, _)| is_held_out(*index)).count();
    let picture_every = held_out.div_ceil(MAX_PICTURES).max(1);
    let mut seen = 0;
    let mut picture_error = None;
    let mut on_held_out = |view: ComparedView| {
        if seen % picture_every == 0 && picture_error.is_none() {
            picture_error = write_picture(out, &view).err();
        }
        seen += 1;
        comparison.views.push(view.figures);
    };
    let selection = ViewSelection {
        poses: &subject.poses,
        keyframes: &subject.keyframe_indices,
        is_held_out: &is_held_out,
        exposures: &subject.exposures,
    };
    let images = evaluate_views((sequence, config.map_scale), (gpu, subject.cloud), &selection, &mut on_held_out, progress)?;
    if let Some(error) = picture_error {
        return Err(error);
    }
    write_records(&out.join(COMPARISON), &comparison)?;
    Ok(Measured {
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

/// Of a held-out view in [`VIEWS`].
pub fn picture_name(frame: usize) -> String {
    format!("{frame:06}.png")
}

fn write_records(path: &Path, records: &impl Serialize) -> Result<(), ExportError> {
    let text = serde_json::to_string(records).expect("records are numbers, which JSON can hold");
    write_atomically(path, text.as_bytes())
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

/// Puts all figures of a run together and writes `metrics.json`.
pub fn write_metrics(
    (sequence, config): (&Sequence, &Config),
    gpu: &Gpu,
    outcome: &Outcome,
    (measured, map): (Measured, WrittenMap),
    out: &Path,
) -> Result<Metrics, OutputError> {
    let frames = sequence.entries.len() as u64;
    let iterations = outcome.step_ms.len() as u64;
    let pinhole = sequence.camera.pinhole.scaled(config.map_scale);
    let metrics = Metrics {
        sequence: sequence.name.clone(),
        sensor: sequence.sensor.kind(),
        paced: config.replay.paced,
        frames,
        frames_read_failed: outcome.frames_read_failed as u64,
        frames_tracked: outcome.poses.len() as u64,
        frames_late: outcome.frames_late as u64,
        keyframes_deferred: outcome.keyframes_deferred as u64,
        keyframes: Some(outcome.keyframes.len() as u64),
        ate_rmse_m: measured.ate_rmse_m,
        rpe: measured.rpe,
        images: measured.images,
        gaussians: Some(outcome.cloud.len() as u64),
        map_bytes: Some(map.bytes),
        map_hash: Some(map.hash),
        wall_s: Some(outcome.wall_s),
        resumed: outcome.resumed,
        tracking_ms: Times::of(&outcome.tracking_ms),
        mapping: Some(MappingFigures {
            iterations,
            iterations_per_frame: iterations as f64 / frames.max(1) as f64,
            ms_per_iteration: UsualTimes::of(&outcome.step_ms),
            map_width: pinhole.width,
            map_height: pinhole.height,
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
