//! Progress of a run, and errors of its threads.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::queue::ArrayQueue;
use image::RgbImage;

use super::control::Control;
use super::newest::Newest;
use crate::export::ExportError;
use crate::geometry::Se3;
use crate::mapping::{KeyframeId, MappingError};
use crate::render::Rendered;
use crate::run_folder::CheckpointError;
use crate::splat::{MapSnapshot, ViewCamera};
use crate::tracking::{KeyframePose, TrackingError};

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
    /// The map to begin with cannot be read.
    #[error("the initial map: {0}; a resumed run needs it unchanged at the same place")]
    InitialMap(#[from] ExportError),
    /// There is no map to begin with.
    #[error("the initial map {path} is no map that is read; give a .ply, .spz, .sog, .glb or .splat, or the folder of a run")]
    NoInitialMap {
        /// The file or folder.
        path: PathBuf,
    },
    /// The map to begin with holds nothing.
    #[error("the initial map {path} holds no Gaussians; give another map, or leave --initial-map out")]
    EmptyInitialMap {
        /// The file.
        path: PathBuf,
    },
    /// A file of the run to be refined cannot be used.
    #[error("cannot refine the run: {path} {reason}; give the folder of a run of this recording")]
    RefinedRun {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// No keyframe sees the region to be refined.
    #[error("no keyframe of the run sees the region; give one in which its cameras see Gaussians")]
    NotSeen,
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
    /// Pose of the last frame that has one.
    pub world_from_camera: Option<Se3>,
    /// Tracking time of the last frame, milliseconds.
    pub frame_ms: f64,
}

/// Progress of the mapping thread.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MappingProgress {
    /// Keyframes mapped so far.
    pub keyframes: usize,
    /// Gaussians in the map.
    pub gaussians: usize,
    /// Optimisation steps so far.
    pub steps: usize,
    /// Mean PSNR of the newest steps' views, before each step.
    pub psnr_db: f32,
    /// Duration of the newest step, milliseconds.
    pub step_ms: f64,
    /// Steps of the final refinement, taken and planned, once it has begun.
    pub refinement: Option<(usize, Option<usize>)>,
}

/// Keyframes as the tracker has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeyframePoses {
    /// All of them, ascending by id.
    pub keyframes: Vec<KeyframePose>,
    /// Pairs that closed loops join.
    pub loops: Vec<[KeyframeId; 2]>,
}

/// Image of a frame.
#[derive(Clone, Debug)]
pub struct FrameImage {
    /// Index of the frame.
    pub frame: usize,
    /// As recorded.
    pub color: RgbImage,
}

/// A view of the map to be rendered by the mapper, between two batches of its steps.
pub struct RenderOrder {
    /// The view.
    pub camera: ViewCamera,
    /// Receives the view, or why there is none.
    pub reply: Box<dyn FnOnce(Result<Rendered, String>) + Send>,
}

/// Views that wait for the mapper, at most.
const MOST_ORDERS: usize = 4;

/// A run as others see and steer it: the newest value of each kind, and switches. No thread of the run waits for a reader.
#[derive(Clone, Debug, Default)]
pub struct Progress {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    tracking: Newest<TrackingProgress>,
    mapping: Newest<MappingProgress>,
    snapshots: Newest<MapSnapshot>,
    poses: Newest<KeyframePoses>,
    images: Newest<FrameImage>,
    orders: Orders,
    closed: AtomicBool,
    control: Control,
}

/// Views that wait for the mapper.
struct Orders(ArrayQueue<RenderOrder>);

impl Default for Orders {
    fn default() -> Self {
        Self(ArrayQueue::new(MOST_ORDERS))
    }
}

impl std::fmt::Debug for Orders {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} of {MOST_ORDERS} orders", self.0.len())
    }
}

impl Progress {
    /// Progress of the tracker.
    pub fn tracking(&self) -> &Newest<TrackingProgress> {
        &self.shared.tracking
    }

    /// Progress of the mapper.
    pub fn mapping(&self) -> &Newest<MappingProgress> {
        &self.shared.mapping
    }

    /// The map; a newer one is downloaded where it is wanted.
    pub fn snapshots(&self) -> &Newest<MapSnapshot> {
        &self.shared.snapshots
    }

    /// The keyframes, where they are wanted.
    pub fn poses(&self) -> &Newest<KeyframePoses> {
        &self.shared.poses
    }

    /// The image of the last frame, where it is wanted.
    pub fn images(&self) -> &Newest<FrameImage> {
        &self.shared.images
    }

    /// Switches of the run.
    pub fn control(&self) -> &Control {
        &self.shared.control
    }

    /// Whether the run is to end early.
    pub fn stopped(&self) -> bool {
        self.control().is_stopped()
    }

    /// Orders a view; `false` if too many wait, or the mapper has gone.
    pub fn order(&self, order: RenderOrder) -> bool {
        !self.shared.closed.load(Ordering::Relaxed) && self.shared.orders.0.push(order).is_ok()
    }

    /// The mapper goes: no order is taken any more, and those that wait are dropped with their replies.
    pub fn close_orders(&self) {
        self.shared.closed.store(true, Ordering::Relaxed);
        while self.next_order().is_some() {}
    }

    /// The oldest order, taken off.
    pub(super) fn next_order(&self) -> Option<RenderOrder> {
        self.shared.orders.0.pop()
    }

    /// Whether a view is ordered.
    pub(super) fn has_order(&self) -> bool {
        !self.shared.orders.0.is_empty()
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
