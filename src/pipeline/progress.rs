//! Progress of a run, and errors of its threads.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::queue::ArrayQueue;

use crate::mapping::MappingError;
use crate::run_folder::CheckpointError;
use crate::splat::MapSnapshot;
use crate::tracking::TrackingError;

/// A run that ended early.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The tracker failed.
    #[error(transparent)]
    Tracking(#[from] TrackingError),
    /// The mapper failed.
    #[error(transparent)]
    Mapping(#[from] MappingError),
    /// A bug of ours.
    #[error("the {thread} thread panicked: {message}; what was done until then is kept. Please report this")]
    Panicked {
        /// Its name.
        thread: &'static str,
        /// The panic's message.
        message: String,
    },
    /// The system starts no more threads.
    #[error("the {thread} thread could not be started: {source}")]
    Spawn {
        /// Its name.
        thread: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
    /// No frame is readable.
    #[error(
        "not one of the {frames} frames could be read; the first one failed so: {first}; check that the recording was copied whole"
    )]
    NothingRead {
        /// Frames of the selection.
        frames: usize,
        /// Error of the first one.
        first: String,
    },
    /// Known poses without depth and points, of frames that do not give points.
    #[error(
        "only {points} points could be triangulated from the frames of {name}; check that its poses are right, that its photos overlap and have texture, or give points (COLMAP's sparse/0/points3D.bin) or depth"
    )]
    NoStructure {
        /// Name of the recording.
        name: String,
        /// Points found.
        points: usize,
    },
    /// A resumed run was stopped before it reached its checkpoint.
    #[error("the run ended before it had caught up with {checkpoint}, which is kept; resume it again")]
    NotCaughtUp {
        /// Its file.
        checkpoint: PathBuf,
    },
    /// A resumed run's tracking differs from the interrupted run's.
    #[error(
        "{checkpoint} cannot be resumed: this recording and its tracking are not what they were then; put the recording back as it was, or make the run anew"
    )]
    NotRepeated {
        /// Its file.
        checkpoint: PathBuf,
    },
    /// A checkpoint that cannot be resumed.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
}

/// Progress of the tracking thread.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackingProgress {
    /// Frames read so far.
    pub frames_done: usize,
    /// Keyframes so far.
    pub keyframes: usize,
    /// Whether the last frame has no pose.
    pub lost: bool,
}

/// Progress of a run, shared with a display: each slot holds the newest value.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Newest progress of the tracker.
    pub tracking: Arc<ArrayQueue<TrackingProgress>>,
    /// Newest snapshot of the map.
    pub mapping: Arc<ArrayQueue<MapSnapshot>>,
    /// Set to end the run early; its partial result is returned.
    pub stop: Arc<AtomicBool>,
}

impl Default for Progress {
    fn default() -> Self {
        Self { tracking: Arc::new(ArrayQueue::new(1)), mapping: Arc::new(ArrayQueue::new(1)), stop: Arc::default() }
    }
}

impl Progress {
    /// Whether the run is to end early.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// Converts a panic in one piece of a thread's work to an error, so that the thread's results survive.
pub(super) fn guarded<T>(thread: &'static str, work: impl FnOnce() -> Result<T, PipelineError>) -> Result<T, PipelineError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|payload| {
        let text = payload.downcast_ref::<&str>().map(ToString::to_string);
        let message = text.or_else(|| payload.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".into());
        Err(PipelineError::Panicked { thread, message })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error_that_names_the_thread() {
        let error = guarded::<()>("mapping", || panic!("index {}", 7)).unwrap_err();
        assert!(error.to_string().starts_with("the mapping thread panicked: index 7"));
    }
}
