//! The result of a run, as its folder stores it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::history::{History, KeyframeRecord};
use crate::evaluation::{ExposureRecord, Exposures, metrics};
use crate::geometry::{Se3, StampedPose, Trajectory};
use crate::mapping::{KeyframeId, PagingFigures};
use crate::splat::{Exposure, GaussianCloud};
use crate::tracking::{DepthBias, KeyframePose};

/// Trajectory, map and records of a run, whether or not it reached its end.
#[derive(Clone, Debug, Default)]
pub struct RunResult {
    /// The map after the last finished keyframe or round of the final refinement.
    pub cloud: Arc<GaussianCloud>,
    /// Frame index and `world_from_camera` of every tracked frame.
    pub poses: Vec<(usize, StampedPose)>,
    /// Poses without frame indices.
    pub trajectory: Trajectory,
    /// All keyframes but image-only ones, in order of creation.
    pub keyframes: Vec<KeyframePose>,
    /// Exposures of the image-only keyframes.
    pub image_exposures: Vec<ExposureRecord>,
    /// Records of frames and keyframes.
    pub history: History,
    /// Frames that could not be read.
    pub frames_read_failed: usize,
    /// Real time: frames dropped because the tracker was busy.
    pub frames_late: usize,
    /// Real time: keyframes that the mapper never received.
    pub keyframes_deferred: usize,
    /// Systematic error of the depth images, if it was estimated.
    pub depth_bias: Option<DepthBias>,
    /// Standard deviation of keypoints as the tracker left it, pixels; `None` with known poses.
    pub pixel_sigma: Option<f64>,
    /// Tracking time of each frame, milliseconds.
    pub tracking_ms: Vec<f64>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    /// What left the adapter for the disk.
    pub paging: PagingFigures,
    /// Wall-clock time, seconds; of all processes of a resumed run, up to their checkpoints.
    pub wall_s: f64,
    /// Number of resumptions from a checkpoint.
    pub resumed: u64,
}

impl RunResult {
    /// What left the adapter for the disk, if anything did.
    pub(super) fn paging_figures(&self) -> Option<metrics::PagingFigures> {
        let PagingFigures { gaussians_out, gaussians_in, most_away } = self.paging;
        (gaussians_out > 0).then_some(metrics::PagingFigures { gaussians_out, gaussians_in, most_away })
    }

    /// Poses of the keyframes.
    pub fn keyframe_trajectory(&self) -> Trajectory {
        Trajectory { poses: self.keyframes.iter().map(KeyframePose::stamped).collect() }
    }

    /// Frame indices of the keyframes.
    pub fn keyframe_indices(&self) -> BTreeSet<usize> {
        self.keyframes.iter().map(|k| k.frame_index).collect()
    }

    /// Frame index and `world_from_camera` of every tracked frame.
    pub fn frame_poses(&self) -> Vec<(usize, Se3)> {
        self.poses.iter().map(|(index, pose)| (*index, pose.world_from_camera)).collect()
    }

    /// Estimated exposures of the mapped keyframes.
    pub fn exposures(&self) -> Exposures {
        exposures(&self.keyframes, &self.history.keyframes, &self.image_exposures)
    }
}

/// Exposures of image-only keyframes that were tracked and mapped.
pub(crate) fn image_exposures(tracked: &[KeyframePose], mapped: &BTreeMap<KeyframeId, Exposure>) -> Vec<ExposureRecord> {
    let record = |k: &KeyframePose| Some(ExposureRecord { timestamp_s: k.timestamp_s, log_gain: *mapped.get(&k.frame_index)? });
    tracked.iter().filter_map(record).collect()
}

/// Exposures of mapped keyframes at the timestamps of tracked ones, those of image-only ones among them.
pub(crate) fn exposures(tracked: &[KeyframePose], mapped: &[KeyframeRecord], images: &[ExposureRecord]) -> Exposures {
    let times: BTreeMap<usize, f64> = tracked.iter().map(|k| (k.frame_index, k.timestamp_s)).collect();
    let record = |KeyframeRecord { report, .. }: &KeyframeRecord| {
        Some(ExposureRecord { timestamp_s: *times.get(&report.id)?, log_gain: report.exposure })
    };
    Exposures::new(mapped.iter().filter_map(record).chain(images.iter().copied()).collect())
}
