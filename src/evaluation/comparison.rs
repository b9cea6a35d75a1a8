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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::trajectory::{Alignment, evaluate_trajectory};
    use crate::geometry::Se3;

    fn path(points: &[(f64, [f64; 3])]) -> Trajectory {
        let pose = |&(timestamp_s, [x, y, z]): &(f64, [f64; 3])| StampedPose {
            timestamp_s,
            world_from_camera: Se3::translation(x, y, z),
        };
        Trajectory { poses: points.iter().map(pose).collect() }
    }

    #[test]
    fn a_comparison_is_in_the_frame_of_the_truth() {
        let truth = path(&[
            (-1.0, [9.0; 3]),
            (0.0, [0.0, 0.0, 0.0]),
            (1.0, [1.0, 0.0, 0.0]),
            (2.0, [1.0, 2.0, 0.0]),
            (3.0, [0.0, 2.0, 3.0]),
            (4.0, [9.0; 3]),
        ]);
        let shifted: Vec<_> = truth.poses[1..5]
            .iter()
            .map(|p| (p.timestamp_s, p.world_from_camera.translation.vector.add_scalar(5.0).into()))
            .collect();
        let estimate = path(&[&shifted[..3], &[(2.5, [7.0; 3])], &shifted[3..]].concat());
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap();
        let found = Comparison::of(&estimate, Some((&truth, &errors)));
        assert_eq!(found.truth, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [0.0, 2.0, 3.0]]);
        assert_eq!(found.poses.iter().map(|p| p.error_m.is_some()).collect::<Vec<_>>(), [true, true, true, false, true]);
        assert!(found.poses.iter().filter_map(|p| p.error_m).all(|error| error < 1e-9), "{found:?}");
        let alone = Comparison::of(&estimate, None);
        assert_eq!((alone.poses[3].position, alone.poses[3].error_m), ([7.0; 3], None));
        assert!(alone.truth.is_empty() && alone.poses.len() == 5);
    }
}
