//! `comparison.json`: pose by pose and view by view what the figures of a run are the means of.

use serde::{Deserialize, Serialize};

use super::trajectory::{MAX_TIME_DIFFERENCE_S, TrajectoryErrors, associate};
use super::views::ViewRecord;
use crate::geometry::{StampedPose, Trajectory};

/// A run beside the truth and beside what was recorded.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// In the frame of the truth; without truth in their own.
    pub poses: Vec<PoseRecord>,
    /// The true path of the same time, metres; empty where it is not known.
    pub truth: Vec<[f64; 3]>,
    /// The held-out views.
    pub views: Vec<ViewRecord>,
}

/// Where a frame was taken.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseRecord {
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// Camera centre, metres.
    pub position: [f64; 3],
    /// Distance from the truth of the same time.
    pub error_m: Option<f64>,
}

impl Comparison {
    /// A trajectory, beside its truth if that is known; views are still to be added.
    pub fn of(estimate: &Trajectory, truth: Option<(&Trajectory, &TrajectoryErrors)>) -> Self {
        let position = |pose: &StampedPose| match truth {
            Some((_, errors)) => errors.alignment.act(&pose.world_from_camera.translation.vector.into()).coords,
            None => pose.world_from_camera.translation.vector,
        };
        let record =
            |pose: &StampedPose| PoseRecord { timestamp_s: pose.timestamp_s, position: position(pose).into(), error_m: None };
        let mut poses: Vec<PoseRecord> = estimate.poses.iter().map(record).collect();
        let Some((truth, _)) = truth else { return Self { poses, ..Self::default() } };
        for pair in associate(truth, estimate, MAX_TIME_DIFFERENCE_S) {
            let real = truth.poses[pair.truth].world_from_camera.translation.vector;
            poses[pair.estimate].error_m = Some((position(&estimate.poses[pair.estimate]) - real).norm());
        }
        let time = |pose: Option<&StampedPose>| pose.map_or(0.0, |p| p.timestamp_s);
        let (start, end) = (time(estimate.poses.first()), time(estimate.poses.last()));
        let during = truth.poses.iter().filter(|p| (start..=end).contains(&p.timestamp_s));
        let path = during.map(|pose| pose.world_from_camera.translation.vector.into()).collect();
        Self { poses, truth: path, views: Vec::new() }
    }
}
