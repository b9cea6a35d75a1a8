//! Tracking from ORB features for RGB-D, stereo and one camera alone, after ORB-SLAM2 (Mur-Artal & Tardós, *IEEE T-RO* 2017) in our own
//! code: features, PnP, and the fits behind a two-view start are OpenCV's, everything else is here.
//!
//! One frame: features, with depth where the sensor gives it → the pose predicted from the last motion → last frame's points → the local
//! map; all pixels where features are too few (RGB-D). Now and then a keyframe: landmarks from depth and by triangulation, joined with
//! what its neighbours see → local bundle adjustment in a thread beside → loop closing → culling of what became redundant. Only the
//! caller's thread changes the map, and in deterministic replay it does so in one fixed order: the same frames give the same bits. Knows nothing of the
//! mapper or the GPU.

mod adjustment;
mod allocator;
mod config;
mod error;
pub(crate) mod features;
mod front_end;
pub(crate) mod initialisation;
mod localisation;
mod loop_closing;
pub(crate) mod map;
mod rig;
mod self_calibration;
pub(crate) mod solvers;
pub(crate) mod structure;
mod tracker;
mod worker;

pub use config::TrackingConfig;
pub use error::TrackingError;
pub use front_end::{ExtractedFrame, FrontEnd};
pub use loop_closing::ClosedLoop;
pub use self_calibration::{SelfCalibration, SelfCalibrationError, self_calibrate};
pub use solvers::depth_bias::DepthBias;
pub use tracker::Tracker;
pub(crate) use tracker::is_image_due;

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use crate::geometry::{Se3, StampedPose};

/// Whether a frame has a pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackingState {
    /// The frame has a pose.
    Tracking,
    /// No pose that can be trusted; the frame left no trace in the map.
    Lost,
}

/// Result of tracking one frame.
#[derive(Clone, Debug)]
pub struct TrackedFrame {
    /// Whether the frame has a pose.
    pub state: TrackingState,
    /// Current estimate; later keyframe corrections move it (see [`Tracker::trajectory`]). `None` when lost.
    pub world_from_camera: Option<Se3>,
    /// Landmarks that agree with the pose.
    pub inliers: usize,
    /// Set if this frame became a keyframe, image-only or not.
    pub keyframe: Option<NewKeyframe>,
    /// Earlier keyframes that bundle adjustment or a closed loop moved, as they were taken in with this frame.
    pub updates: Vec<KeyframeUpdate>,
    /// Time of each stage; the only field that differs between identical runs.
    pub times: StageTimes,
}

/// A frame that became a keyframe.
#[derive(Clone, Debug, PartialEq)]
pub struct NewKeyframe {
    /// Index of its frame in the replay.
    pub id: usize,
    /// Before its bundle adjustment, whose result follows as an update.
    pub world_from_camera: Se3,
    /// Where it sees landmarks, and how far along z: pixels of the distortion-free pinhole, metres. For the mapper of a camera without a
    /// depth image; empty where frames have one.
    pub seen: Vec<(Vector2<f64>, f64)>,
    /// Other keyframes (id) and how many landmarks they share with this one, strongest first; of an image-only one none are named.
    pub covisible: Vec<(usize, usize)>,
    /// Whether only its image counts: it holds no landmarks.
    pub image_only: bool,
}

/// Correction of an earlier keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframeUpdate {
    /// Its id.
    pub id: usize,
    /// New pose, metres.
    pub world_from_camera: Se3,
    /// Factor by which closed loops have scaled the lengths around it since its last update; 1 with measured depth.
    pub scale: f64,
}

/// A keyframe as currently estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframePose {
    /// Index of its frame in the replay, by which others name it.
    pub frame_index: usize,
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// Pose, metres.
    pub world_from_camera: Se3,
}

impl KeyframePose {
    /// The pose with its time, without the frame.
    pub fn stamped(&self) -> StampedPose {
        StampedPose { timestamp_s: self.timestamp_s, world_from_camera: self.world_from_camera }
    }
}

/// Wall-clock time of each stage, milliseconds; 0 where it did not run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageTimes {
    /// ORB extraction and depth lookup.
    pub features_ms: f64,
    /// Matching and pose optimisation.
    pub localise_ms: f64,
    /// New landmarks, joining with neighbours.
    pub mapping_ms: f64,
    /// Bundle adjustment in the tracking thread: assembling, waiting, applying.
    pub bundle_ms: f64,
    /// Looking for a loop, and closing it.
    pub loops_ms: f64,
}

impl StageTimes {
    /// Sum of all stages, milliseconds.
    pub fn total_ms(&self) -> f64 {
        self.features_ms + self.localise_ms + self.mapping_ms + self.bundle_ms + self.loops_ms
    }
}

impl TrackedFrame {
    fn lost(times: StageTimes) -> Self {
        Self { state: TrackingState::Lost, world_from_camera: None, inliers: 0, keyframe: None, updates: Vec::new(), times }
    }
}
