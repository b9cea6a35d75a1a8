//! What the threads tell each other, and how they fail.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::queue::ArrayQueue;

use super::CheckpointError;
use crate::export::ExportError;
use crate::geometry::Se3;
use crate::mapping::{Keyframe, KeyframeId, MappingError};
use crate::sequence::KnownPoint;
use crate::splat::MapSnapshot;
use crate::tracking::TrackingError;

#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    #[error(transparent)]
    Tracking(#[from] TrackingError),
    #[error(transparent)]
    Mapping(#[from] MappingError),
    #[error("the {thread} thread panicked: {message}; what was done until then is kept. Please report this")]
    Panicked { thread: &'static str, message: String },
    #[error("the {thread} thread could not be started: {source}")]
    Spawn { thread: &'static str, source: std::io::Error },
    #[error(
        "the first frame, {color}, has no depth image near its time; the map is started from depth: give the recording's depth (depth.txt), or begin at a frame that has one with --frames"
    )]
    NoFirstDepth { color: PathBuf },
    #[error(
        "{name} has no pose within {seconds} s of any frame; known poses come from COLMAP's model, transforms.json or the recording's ground truth: leave --known-poses out to track instead"
    )]
    NoKnownPoses { name: String, seconds: f64 },
    #[error(
        "{name} has neither depth nor points to begin a map from; give COLMAP's model with its points (sparse/0/points3D.bin), or leave --known-poses out"
    )]
    NoKnownPoints { name: String },
    #[error(
        "images would be mapped at {width}x{height}, but the least is {least}x{least}; raise the mapping resolution (--map-scale)"
    )]
    TooSmall { width: u32, height: u32, least: u32 },
    #[error(
        "not one of the {frames} frames could be read; the first one failed so: {first}; check that the recording was copied whole"
    )]
    NothingRead { frames: usize, first: String },
    #[error("the run ended before it had caught up with {checkpoint}, which is kept; resume it again")]
    NotCaughtUp { checkpoint: PathBuf },
    #[error(
        "{checkpoint} cannot be resumed: this recording and its tracking are not what they were then; put the recording back as it was, or make the run anew"
    )]
    NotRepeated { checkpoint: PathBuf },
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Export(#[from] ExportError),
}

/// Tracker → mapper. The end of the sequence is the channel's end.
#[derive(Clone, Debug)]
pub enum MapperMessage {
    /// Points of the scene that came with the recording, before the first keyframe.
    Points(Vec<KnownPoint>),
    Keyframe(Box<Keyframe>),
    /// Earlier keyframes that bundle adjustment moved.
    PoseUpdate(Vec<(KeyframeId, Se3)>),
}

/// Where a run stands, for whoever shows it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackingProgress {
    pub frames_done: usize,
    pub keyframes: usize,
    pub lost: bool,
}

/// The windows onto a run that a display may look through; each slot holds the newest value.
#[derive(Clone, Debug)]
pub struct Progress {
    pub tracking: Arc<ArrayQueue<TrackingProgress>>,
    pub mapping: Arc<ArrayQueue<MapSnapshot>>,
    /// Set to end the run early: what there is will be finished and returned.
    pub stop: Arc<AtomicBool>,
}

impl Default for Progress {
    fn default() -> Self {
        Self { tracking: Arc::new(ArrayQueue::new(1)), mapping: Arc::new(ArrayQueue::new(1)), stop: Arc::default() }
    }
}

impl Progress {
    /// Whether the run was asked to end early.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// Runs one piece of a thread's work; a panic in it becomes an error, and the thread's results survive.
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
