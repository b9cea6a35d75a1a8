//! `history.json`: records of each tracked frame and each mapped keyframe, which `keysplat report` plots.

use serde::{Deserialize, Serialize};

use crate::mapping::KeyframeReport;
use crate::tracking::StageTimes;

/// Records of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct History {
    /// In the order in which they were tracked.
    pub frames: Vec<FrameRecord>,
    /// In the order in which they were mapped.
    pub keyframes: Vec<KeyframeRecord>,
    /// Closed loops: the keyframe that recognised a place and that of the place, by their numbers among the run's keyframes.
    #[serde(default)]
    pub loops: Vec<[usize; 2]>,
}

/// One tracked frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Its index in the sequence as replayed.
    pub frame: usize,
    /// Whether it has no pose.
    pub lost: bool,
    /// Time of each tracking stage.
    #[serde(flatten)]
    pub times: StageTimes,
}

/// One mapped keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeyframeRecord {
    /// Figures of the mapper.
    #[serde(flatten)]
    pub report: KeyframeReport,
    /// When it was finished, seconds since the mapper's start.
    pub done_s: f64,
    /// Duration, seconds.
    pub busy_s: f64,
    /// Messages in the mapper's channel when it began.
    pub waiting: usize,
    /// Resident memory of the process when it was finished, bytes; absent where the system does not report it.
    #[serde(default)]
    pub host_bytes: Option<u64>,
}
