//! How a run went, frame by frame and keyframe by keyframe: `history.json`, which `keysplat report` draws.

use serde::{Deserialize, Serialize};

use crate::mapping::KeyframeReport;
use crate::tracking::StageTimes;

/// A run's course.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct History {
    /// In the order in which they were tracked.
    pub frames: Vec<FrameRecord>,
    /// In the order in which they were mapped.
    pub keyframes: Vec<KeyframeRecord>,
}

/// What the tracker did with a frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Its index in the sequence as replayed.
    pub frame: usize,
    pub lost: bool,
    #[serde(flatten)]
    pub times: StageTimes,
}

/// What the mapper did with a keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeyframeRecord {
    #[serde(flatten)]
    pub report: KeyframeReport,
    /// When it was done, since the start of the mapper.
    pub done_s: f64,
    /// What it took.
    pub busy_s: f64,
    /// Messages that waited for the mapper when it began.
    pub waiting: usize,
    /// Resident memory of the process when it was done, where the system tells.
    #[serde(default)]
    pub host_bytes: Option<u64>,
}
