//! A run from its beginning to its metrics: open, run, write, measure. The one entry for the command line, viewers and bindings.

mod dataset;
mod evaluate;
mod mesh;
mod mesh_errors;
mod split;

use std::path::{Path, PathBuf};
use std::sync::Arc;

pub use dataset::{DatasetCounts, DatasetOptions, DatasetViews, export_dataset};
pub use evaluate::{EvaluateOptions, evaluate_folder};
pub use mesh::{FusedMesh, MapDepth, MeshOptions, mesh_folder};
pub use mesh_errors::{MeshReport, MeshTruthOptions, evaluate_mesh};
pub use split::{Cell, Split, SplitOptions, split_run};

use crate::config::Config;
use crate::evaluation::Metrics;
use crate::geometry::TrajectoryError;
use crate::gpu::{Gpu, GpuError};
use crate::mesh::MeshError;
use crate::pipeline::{self, PipelineError, Progress, Replay};
use crate::recording::{Recording, RecordingError};
use crate::run_folder::outputs::{self, EvaluationInput};
use crate::run_folder::{Checkpoint, CheckpointError, Checkpointer, FolderLock, OutputError, RunResult};
use crate::sequence::Sensor;

/// A recording, an adapter and a locked output folder, ready to run.
///
/// ```
/// use keysplat::{Config, Progress, SceneConfig, Session, synthetic};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let (room, out) = (folder.path().join("room"), folder.path().join("out"));
/// let scene = SceneConfig { frames: 12, ..SceneConfig::default() };
/// synthetic::generate(&scene, &room, &|_done, _total| ())?;
/// let mut config = Config::for_recording(&room);
/// config.map_scale = 0.25;
/// let mut session = Session::open(config, &out)?;
/// let replay = session.run(&Progress::default())?;
/// let metrics = session.finish(replay, &|_views| ())?;
/// println!("{metrics}");
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Session {
    recording: Arc<Recording>,
    gpu: Arc<Gpu>,
    out: PathBuf,
    checkpoint: Option<Checkpoint>,
    _lock: FolderLock,
}

/// A session that cannot begin, or has ended early.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The recording cannot be opened or cannot begin a map.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The adapter cannot be opened, or failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A result cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The checkpoint cannot be read, written or resumed.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The run ended before there was anything to write.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// A trajectory cannot be read.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// A mesh cannot be made.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// Measured depth was asked for.
    #[error(
        "the recording of {folder} has no measured depth at its poses; leave --depth out, or name the recording with --sequence"
    )]
    NoMeasuredDepth {
        /// The run's folder.
        folder: PathBuf,
    },
    /// A file of a run's folder is missing.
    #[error("there is no file {path}; {advice}")]
    Missing {
        /// The file.
        path: PathBuf,
        /// What to do about it.
        advice: &'static str,
    },
    /// A file of a run's folder cannot be read or does not parse.
    #[error("{path} {reason}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The cause, and what to do about it.
        reason: String,
    },
    /// A folder to evaluate that does not name its recording.
    #[error("{folder} has no config.toml that names its recording; name it with --sequence")]
    UnnamedRecording {
        /// The folder.
        folder: PathBuf,
    },
    /// A folder for a dataset that holds something already.
    #[error("{folder} is not empty; give a new folder, or empty it")]
    NotEmpty {
        /// The folder.
        folder: PathBuf,
    },
    /// A run of whose map no keyframe sees anything.
    #[error("no keyframe of {run} sees its map; give a run whose keyframes.txt and map belong together")]
    NothingSeen {
        /// The run's folder.
        run: PathBuf,
    },
    /// A run that would replace the map that it begins with.
    #[error("the initial map {map} lies in the folder of the results, where it would be replaced; choose another --out")]
    InitialMapInOut {
        /// The file or folder.
        map: PathBuf,
    },
    /// A trajectory that belongs to another recording.
    #[error("no pose of {trajectory} is within {seconds} s of a frame of {recording}; name the right recording with --sequence")]
    NoPoseNearFrames {
        /// Its file.
        trajectory: PathBuf,
        /// Largest difference of timestamps, seconds.
        seconds: f64,
        /// Name of the recording.
        recording: String,
    },
    /// A run that cannot be led to the truth.
    #[error("the run in {folder} cannot be aligned with a truth: {reason}")]
    NoAlignment {
        /// The run's folder.
        folder: PathBuf,
        /// The cause.
        reason: String,
    },
    /// A resumed run's recording has moved.
    #[error("the recording is no longer at {path}; name its new place with --sequence")]
    Moved {
        /// Its old path.
        path: PathBuf,
    },
    /// Not one frame has a pose.
    #[error("not one frame could be tracked; {advice}")]
    NothingTracked {
        /// What to check.
        advice: &'static str,
    },
    /// The run was stopped before one frame had a pose.
    #[error("stopped before a frame was tracked, so nothing was written")]
    Stopped,
    /// The run ended early; its partial result is in the folder.
    #[error("{error}\nThe run ended early; what there was until then is in {out}")]
    EndedEarly {
        /// What ended it.
        error: Box<PipelineError>,
        /// The run's folder.
        out: PathBuf,
        /// Figures of the partial result.
        metrics: Box<Metrics>,
    },
    /// The run ended early, and writing its partial result failed.
    #[error("{error}\nThe run ended early, and then: {then}")]
    EndedEarlyUnwritten {
        /// What ended it.
        error: Box<PipelineError>,
        /// What failed then.
        then: Box<OutputError>,
    },
}

impl Session {
    /// Opens the recording and the adapter that `config` names, and locks the folder `out` for the results.
    ///
    /// # Errors
    /// If the recording cannot begin a map, no adapter fits, or the folder cannot be written to or is in use.
    pub fn open(config: Config, out: &Path) -> Result<Self, SessionError> {
        let recording = Recording::open(config)?;
        check_first_frame(&recording)?;
        let gpu = Gpu::open(recording.config().adapter.as_deref())?;
        Self::with_device(recording, gpu, out)
    }

    /// The same with a recording and an adapter that are open already.
    ///
    /// # Errors
    /// If the recording cannot begin a map, or the folder cannot be written to or is in use.
    pub fn with_device(recording: Recording, gpu: Arc<Gpu>, out: &Path) -> Result<Self, SessionError> {
        check_first_frame(&recording)?;
        let config = recording.config();
        if let Some(map) = config.initial_map.as_ref().or(config.refined.as_ref().map(|refined| &refined.run)) {
            let place = |path: &Path| std::fs::canonicalize(path).ok();
            let folder = if map.is_dir() { Some(map.as_path()) } else { map.parent() };
            if place(out).is_some_and(|out| folder.and_then(place) == Some(out)) {
                return Err(SessionError::InitialMapInOut { map: map.clone() });
            }
        }
        let lock = outputs::prepare_folder(out)?;
        Ok(Self { recording: Arc::new(recording), gpu, out: out.into(), checkpoint: None, _lock: lock })
    }

    /// Reopens an interrupted run from the checkpoint in its folder. `moved_to` is the recording's new path, where it has moved.
    ///
    /// # Errors
    /// If there is no checkpoint, it is damaged, or the recording is not where it was; and as [`Self::open`] does.
    pub fn resume(out: &Path, moved_to: Option<&Path>) -> Result<Self, SessionError> {
        let path = out.join(outputs::CHECKPOINT);
        if !path.exists() {
            let advice = "give the folder of a run that was begun with keysplat run --checkpoint-every";
            return Err(SessionError::Missing { path, advice });
        }
        let checkpoint = Checkpoint::read(&path)?;
        let mut config = checkpoint.config()?;
        let sequence = config.sequence.get_or_insert_default();
        if let Some(path) = moved_to {
            // Absolute, so that the next checkpoint finds it from any working directory.
            sequence.path = std::path::absolute(path).unwrap_or_else(|_| path.into());
        } else if !sequence.path.exists() {
            return Err(SessionError::Moved { path: sequence.path.clone() });
        }
        let mut session = Self::open(config, out)?;
        session.checkpoint = Some(checkpoint);
        Ok(session)
    }

    /// The recording with its resolved configuration.
    pub fn recording(&self) -> &Recording {
        &self.recording
    }

    /// The same, for threads that outlive a borrow.
    pub fn shared_recording(&self) -> Arc<Recording> {
        self.recording.clone()
    }

    /// The adapter.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The folder of the results.
    pub fn out(&self) -> &Path {
        &self.out
    }

    /// Tracks and maps the recording. Blocks until the end; `progress` shows it from other threads and stops it early.
    ///
    /// # Errors
    /// If threads cannot be started, or the checkpoint belongs to another run. What ends a run early is in [`Replay::error`].
    pub fn run(&mut self, progress: &Progress) -> Result<Replay, SessionError> {
        let checkpointer = self.checkpointer()?;
        let (sequence, config) = (self.recording.sequence(), self.recording.config());
        tracing::info!(
            sequence = sequence.name,
            sensor = %sequence.sensor.kind(),
            frames = sequence.entries.len(),
            map_scale = config.map_scale,
            adapter = self.gpu.adapter.name,
            "replaying into {}",
            self.out.display()
        );
        let chunks = self.out.join(outputs::CHUNKS);
        Ok(pipeline::run(&self.recording, &self.gpu, progress, checkpointer, Some(&chunks))?)
    }

    /// Writes and measures a replay, even a partial one, and removes the checkpoint of one that reached its end. `on_view` receives the number of
    /// compared views.
    ///
    /// # Errors
    /// If nothing was tracked, nothing could be written, or the replay ended early; in the last case its partial result has been written.
    pub fn finish(&self, replay: Replay, on_view: &dyn Fn(usize)) -> Result<Metrics, SessionError> {
        let Replay { result, error, stopped, .. } = replay;
        if result.poses.is_empty() {
            return Err(self.nothing_made(error, stopped));
        }
        let finished = self.write_and_measure(&result, on_view);
        if error.is_none() && finished.is_ok() && !stopped {
            outputs::remove_checkpoint(&self.out)?;
        } else if self.recording.config().checkpoint_every.is_some() {
            tracing::info!("keysplat resume {} continues from the last checkpoint", self.out.display());
        }
        match (error.map(Box::new), finished) {
            (None, finished) => Ok(finished?),
            (Some(error), Ok(metrics)) => {
                Err(SessionError::EndedEarly { error, out: self.out.clone(), metrics: Box::new(metrics) })
            }
            (Some(error), Err(then)) => Err(SessionError::EndedEarlyUnwritten { error, then: Box::new(then) }),
        }
    }

    /// Writes a replay that reached its end without measuring it.
    ///
    /// # Errors
    /// If the replay ended early, or a result cannot be written.
    pub fn write(&self, replay: Replay) -> Result<RunResult, SessionError> {
        replay.error.map_or(Ok(()), Err)?;
        outputs::write_results(&self.out, &self.recording, &replay.result)?;
        outputs::remove_checkpoint(&self.out)?;
        Ok(replay.result)
    }

    fn write_and_measure(&self, result: &RunResult, on_view: &dyn Fn(usize)) -> Result<Metrics, OutputError> {
        let map = outputs::write_results(&self.out, &self.recording, result)?;
        // As the file holds it: a format may be coarser than the map.
        let input = EvaluationInput { cloud: &map.cloud, ..EvaluationInput::from(result) };
        let evaluation = outputs::evaluate(&self.recording, &self.gpu, &input, &self.out, on_view)?;
        outputs::write_metrics(&self.out, &self.recording, &self.gpu, result, &map, evaluation)
    }

    /// A checkpointer for runs that keep checkpoints.
    fn checkpointer(&mut self) -> Result<Option<Checkpointer>, SessionError> {
        if let Some(checkpoint) = self.checkpoint.take() {
            return Ok(Some(Checkpointer::resume(checkpoint, &self.recording, &self.gpu)?));
        }
        if self.recording.config().checkpoint_every.is_none() {
            return Ok(None);
        }
        let path = self.out.join(outputs::CHECKPOINT);
        Ok(Some(Checkpointer::begin(&path, &self.recording, &self.gpu).map_err(OutputError::from)?))
    }

    /// Without a pose there is no trajectory, no map and no metrics; files of an earlier run in the folder stay.
    fn nothing_made(&self, error: Option<PipelineError>, stopped: bool) -> SessionError {
        match error {
            Some(error) => error.into(),
            None if stopped => SessionError::Stopped,
            None if self.recording.sequence().sensor == Sensor::Mono => SessionError::NothingTracked {
                advice: "the recording was replayed as mono, which needs texture and a camera that moves sideways; if it has depth, check \
                         that its depth.txt, or its depth folder, is there",
            },
            None => SessionError::NothingTracked {
                advice: "the images need texture, and depth between tracking.min_depth_metres and tracking.max_depth_metres",
            },
        }
    }
}

impl Drop for Session {
    /// Gaussians on the disk are of no use without a checkpoint.
    fn drop(&mut self) {
        if !self.out.join(outputs::CHECKPOINT).exists() {
            let _ = std::fs::remove_file(self.out.join(outputs::CHUNKS));
        }
    }
}

/// Checks that tracking can begin a map at the first frame.
fn check_first_frame(recording: &Recording) -> Result<(), RecordingError> {
    if recording.config().replay.known_poses { Ok(()) } else { recording.check_trackable() }
}
