//! Trajectory errors: association by time, alignment, absolute (ATE) and relative (RPE) error.
//!
//! Definitions: Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, 2012; Umeyama, *Least-squares estimation of
//! transformation parameters between two point patterns*, 1991 (`geometry/alignment.rs`). The figures are those of the Python package
//! `evo` (`evo_ape tum truth estimate -a`, `-as`, `--t_max_diff 0.02`); `tests/evo.rs` holds them together.
//!
//! Left out: interpolation of the truth between its stamps, and errors over path lengths (KITTI's).

use nalgebra::Vector3;

use crate::geometry::{self, Se3, Sim3, Trajectory};
use crate::sequence::SensorKind;

/// Two stamps further apart than this are not of the same moment (the TUM benchmark's value).
pub const MAX_TIME_DIFFERENCE_S: f64 = 0.02;

/// Fewer pairs always fit, so their error says nothing.
const MIN_PAIRS: usize = 3;

/// Transformation that aligns the estimate before it is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alignment {
    /// SE(3): RGB-D and stereo, which know their scale.
    Rigid,
    /// Sim(3): monocular, whose scale is free.
    Similarity,
}

impl Alignment {
    /// The alignment of a sensor's trajectories.
    pub fn of(sensor: SensorKind) -> Self {
        match sensor {
            SensorKind::Mono => Self::Similarity,
            SensorKind::Stereo | SensorKind::Rgbd => Self::Rigid,
        }
    }
}

/// Trajectories that cannot be aligned.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum AlignmentError {
    /// Too few poses have a true pose at their time.
    #[error(
        "only {pairs} poses lie within {max_difference_s} s of the truth's; at least {MIN_PAIRS} are needed: check that both count time from the same start"
    )]
    TooFewPairs {
        /// Poses with a true pose.
        pairs: usize,
        /// Largest difference of associated timestamps, seconds.
        max_difference_s: f64,
    },
    /// The camera did not move, which leaves the scale undefined.
    #[error("the camera stands still, so no scale can be found; align rigidly")]
    NoScale,
}

/// Positions (in `poses`) of two poses of the same moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pair {
    /// Index of the true pose.
    pub truth: usize,
    /// Index of the estimated pose.
    pub estimate: usize,
}

/// All figures of one estimate against the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryErrors {
    /// Poses that had truth; the others count nowhere.
    pub pairs: usize,
    /// Absolute translation error after alignment, metres.
    pub ate_rmse_m: f64,
    /// Median of the absolute translation error, metres.
    pub ate_median_m: f64,
    /// Maximum of the absolute translation error, metres.
    pub ate_max_m: f64,
    /// Relative pose errors.
    pub rpe: RelativeErrors,
    /// `truth_from_estimate`, between the two worlds.
    pub alignment: Sim3,
}

/// Root mean squares of the motion error between neighbouring pairs.
///
/// A *step* goes from one associated pair to the next: what `evo_rpe --delta 1 --delta_unit f` measures. Where truth exists for
/// every n-th frame only, or frames were lost, a step spans n frames, and its error is divided by n before squaring: a mean
/// rate of drift. Drift adds up over a step and comes out the same for every n; noise of single poses does not, and comes out
/// up to n times smaller than with truth at each frame. Compare only runs against the same truth. A frame's duration is the
/// median over the estimate. Two poses that share one true pose make no step here, though one of no true motion in evo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeErrors {
    /// Pairs of consecutive associated poses.
    pub steps: usize,
    /// Translation, metres a step.
    pub trans_m_per_step: f64,
    /// Rotation, degrees a step.
    pub rot_deg_per_step: f64,
    /// Translation, metres a frame.
    pub trans_m_per_frame: f64,
    /// Rotation, degrees a frame.
    pub rot_deg_per_frame: f64,
    /// Translation, metres a second.
    pub trans_m_per_s: f64,
    /// Rotation, degrees a second.
    pub rot_deg_per_s: f64,
}

/// Pairs poses of the same moment: for each pose of the shorter trajectory the nearest in time of the longer one, if within
/// `max_difference_s`; of two equally near ones the earlier; on equal lengths the estimate counts as the shorter. One to one
/// wherever the longer trajectory is also the denser one; elsewhere a pose of the longer one may serve twice, as in evo.
pub fn associate(truth: &Trajectory, estimate: &Trajectory, max_difference_s: f64) -> Vec<Pair> {
    let truth_is_shorter = truth.poses.len() < estimate.poses.len();
    let (shorter, longer) = if truth_is_shorter { (truth, estimate) } else { (estimate, truth) };
    let partners = shorter.poses.iter().map(|pose| longer.nearest(pose.timestamp_s, max_difference_s));
    partners
        .enumerate()
        .filter_map(|(i, partner)| {
            let (truth, estimate) = if truth_is_shorter { (i, partner?) } else { (partner?, i) };
            Some(Pair { truth, estimate })
        })
        .collect()
}

/// Aligns an estimate with the truth and measures it; stamps are associated within [`MAX_TIME_DIFFERENCE_S`].
///
/// For the error over keyframes give a trajectory of keyframes only: the alignment is then theirs too, as in MonoGS.
///
/// # Errors
/// [`AlignmentError::TooFewPairs`] below three associated poses, [`AlignmentError::NoScale`] if the scale is free and the camera stands still.
pub fn evaluate_trajectory(
    truth: &Trajectory,
    estimate: &Trajectory,
    alignment: Alignment,
) -> Result<TrajectoryErrors, AlignmentError> {
    let pairs = associate(truth, estimate, MAX_TIME_DIFFERENCE_S);
    let position = |trajectory: &Trajectory, i: usize| trajectory.poses[i].world_from_camera.translation.vector;
    let from: Vec<_> = pairs.iter().map(|pair| position(estimate, pair.estimate)).collect();
    let to: Vec<_> = pairs.iter().map(|pair| position(truth, pair.truth)).collect();
    let alignment = align(&from, &to, alignment)?;

    let mut errors_m: Vec<f64> = from.iter().zip(&to).map(|(a, b)| (moved(&alignment, a) - b).norm()).collect();
    let ate_rmse_m = root_mean_square(errors_m.iter().copied());
    errors_m.sort_by(f64::total_cmp);
    Ok(TrajectoryErrors {
        pairs: pairs.len(),
        ate_rmse_m,
        ate_median_m: errors_m[errors_m.len() / 2],
        ate_max_m: errors_m[errors_m.len() - 1],
        rpe: relative_errors(truth, estimate, &pairs, &alignment),
        alignment,
    })
}

/// [`geometry::align`] of at least [`MIN_PAIRS`] pairs.
fn align(from: &[Vector3<f64>], to: &[Vector3<f64>], alignment: Alignment) -> Result<Sim3, AlignmentError> {
    if from.len() < MIN_PAIRS {
        return Err(AlignmentError::TooFewPairs { pairs: from.len(), max_difference_s: MAX_TIME_DIFFERENCE_S });
    }
    geometry::align(from, to, alignment == Alignment::Similarity).ok_or(AlignmentError::NoScale)
}

fn moved(truth_from_estimate: &Sim3, p_in_estimate: &Vector3<f64>) -> Vector3<f64> {
    truth_from_estimate.act(&(*p_in_estimate).into()).coords
}

fn relative_errors(truth: &Trajectory, estimate: &Trajectory, pairs: &[Pair], alignment: &Sim3) -> RelativeErrors {
    let frame_period_s = median_period_s(estimate);
    let mut steps = Vec::with_capacity(pairs.len());
    for step in pairs.windows(2) {
        let (from, to) = (step[0], step[1]);
        let duration_s = estimate.poses[to.estimate].timestamp_s - estimate.poses[from.estimate].timestamp_s;
        if from.truth == to.truth || duration_s <= 0.0 {
            continue;
        }
        let motion = |a: &Se3, b: &Se3| a.inverse() * b;
        let pose = |i: usize| {
            let world_from_camera = &estimate.poses[i].world_from_camera;
            let centre = moved(alignment, &world_from_camera.translation.vector);
            Se3::from_parts(centre.into(), alignment.rotation * world_from_camera.rotation)
        };
        let true_motion = motion(&truth.poses[from.truth].world_from_camera, &truth.poses[to.truth].world_from_camera);
        let error = true_motion.inverse() * motion(&pose(from.estimate), &pose(to.estimate));
        let frames = (duration_s / frame_period_s).round().max(1.0);
        steps.push((error.translation.vector.norm(), error.rotation.angle().to_degrees(), frames, duration_s));
    }
    let rms = |of: fn(&(f64, f64, f64, f64)) -> f64| root_mean_square(steps.iter().map(of));
    RelativeErrors {
        steps: steps.len(),
        trans_m_per_step: rms(|(metres, ..)| *metres),
        rot_deg_per_step: rms(|(_, degrees, ..)| *degrees),
        trans_m_per_frame: rms(|(metres, _, frames, _)| metres / frames),
        rot_deg_per_frame: rms(|(_, degrees, frames, _)| degrees / frames),
        trans_m_per_s: rms(|(metres, _, _, seconds)| metres / seconds),
        rot_deg_per_s: rms(|(_, degrees, _, seconds)| degrees / seconds),
    }
}

/// The usual time from one pose to the next: a frame's, as long as most frames have a pose.
fn median_period_s(trajectory: &Trajectory) -> f64 {
    let mut periods: Vec<f64> = trajectory.poses.windows(2).map(|w| w[1].timestamp_s - w[0].timestamp_s).collect();
    periods.sort_by(f64::total_cmp);
    periods.get(periods.len() / 2).copied().unwrap_or(f64::INFINITY)
}

/// Zero for no values.
fn root_mean_square(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    (values.map(|value| value * value).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{StampedPose, se3};
    use nalgebra::Vector6;
    use proptest::prelude::*;

    fn path(stamps_s: impl IntoIterator<Item = f64>) -> Trajectory {
        let pose = |t: f64| se3::exp(&Vector6::new(t.sin(), 0.3 * t, (0.7 * t).cos(), 0.2 * t, 0.1 * t.sin(), -0.1 * t));
        Trajectory { poses: stamps_s.into_iter().map(|t| StampedPose { timestamp_s: t, world_from_camera: pose(t) }).collect() }
    }

    fn shifted(trajectory: &Trajectory, tau: &Vector6<f64>, scale: f64) -> Trajectory {
        let mut moved = trajectory.clone();
        for pose in &mut moved.poses {
            let mut pose_in_b = se3::exp(tau) * pose.world_from_camera;
            pose_in_b.translation.vector *= scale;
            pose.world_from_camera = pose_in_b;
        }
        moved
    }

    proptest! {
        #[test]
        fn a_moved_trajectory_has_no_error(tau in prop::array::uniform6(-2.0f64..2.0), scale in 0.1f64..10.0) {
            let truth = path((0..40).map(|i| f64::from(i) * 0.1));
            let tau = Vector6::from(tau);
            let rigid = evaluate_trajectory(&truth, &shifted(&truth, &tau, 1.0), Alignment::Rigid).unwrap();
            prop_assert!(rigid.ate_rmse_m < 1e-12 && rigid.rpe.trans_m_per_frame < 1e-12 && rigid.rpe.rot_deg_per_frame < 1e-6);
            let scaled = evaluate_trajectory(&truth, &shifted(&truth, &tau, scale), Alignment::Similarity).unwrap();
            prop_assert!(scaled.ate_rmse_m < 1e-11 && scaled.rpe.trans_m_per_frame < 1e-11);
            prop_assert!((scaled.alignment.scale * scale - 1.0).abs() < 1e-11);
        }
    }

    #[test]
    fn steps_over_several_frames_are_divided_by_them() {
        // An estimate that drifts by 2 mm in each frame of 0.1 s, against a camera that stands still: truth at every frame and
        // truth at every 4th give the same rates.
        let still = |stamps: Vec<f64>| Trajectory {
            poses: stamps
                .into_iter()
                .map(|t| StampedPose { timestamp_s: t, world_from_camera: se3::exp(&Vector6::zeros()) })
                .collect(),
        };
        let mut estimate = still((0..41).map(|i| f64::from(i) * 0.1).collect());
        for (i, pose) in estimate.poses.iter_mut().enumerate() {
            pose.world_from_camera.translation.vector.x = 0.002 * i as f64;
        }
        for every in [1, 4] {
            let truth = still((0..41).step_by(every).map(|i| f64::from(i) * 0.1).collect());
            let rpe = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap().rpe;
            assert!((rpe.trans_m_per_frame - 0.002).abs() < 1e-9, "{every}: {rpe:?}");
            assert!((rpe.trans_m_per_s - 0.02).abs() < 1e-9, "{every}: {rpe:?}");
            assert!((rpe.trans_m_per_step - 0.002 * every as f64).abs() < 1e-9, "{every}: {rpe:?}");
        }
    }

    #[test]
    fn association_takes_the_nearest_and_nothing_too_far() {
        let truth = path([0.0, 0.1, 0.2, 0.3, 0.5]);
        let estimate = path([0.015, 0.13, 0.19, 0.519]);
        let pairs: Vec<_> = associate(&truth, &estimate, 0.02).iter().map(|p| (p.truth, p.estimate)).collect();
        assert_eq!(pairs, [(0, 0), (2, 2), (4, 3)]);
        assert!(associate(&truth, &Trajectory::default(), 0.02).is_empty());
    }

    #[test]
    fn what_cannot_be_aligned_says_why() {
        let truth = path([0.0, 1.0, 2.0]);
        let few = evaluate_trajectory(&truth, &path([0.0, 1.0, 2.5]), Alignment::Rigid).unwrap_err();
        assert!(few.to_string().starts_with("only 2 poses lie within 0.02 s"), "{few}");
        let still = [Vector3::zeros(); 4];
        assert_eq!(align(&still, &still, Alignment::Similarity), Err(AlignmentError::NoScale));
    }

    #[test]
    fn each_pose_of_the_shorter_trajectory_is_paired() {
        let pairs = |truth: &[f64], estimate: &[f64]| -> Vec<(usize, usize)> {
            let (truth, estimate) = (path(truth.iter().copied()), path(estimate.iter().copied()));
            associate(&truth, &estimate, 0.02).iter().map(|p| (p.truth, p.estimate)).collect()
        };
        assert_eq!(pairs(&[0.0, 0.1], &[0.0, 0.01, 0.1]), [(0, 0), (1, 2)]);
        assert_eq!(pairs(&[0.0, 0.01, 0.1], &[0.0, 0.1]), [(0, 0), (2, 1)]);
        assert_eq!(pairs(&[0.0, 0.01], &[0.0, 0.002]), [(0, 0), (0, 1)], "of equal lengths the estimate counts as the shorter");
    }

    #[test]
    fn the_median_error_is_that_of_the_middle_pose() {
        // Far out, the poses fix the alignment; the errors are 0 to 4 mm, apart from what the alignment takes.
        let truth = path((0..9).map(f64::from));
        let mut estimate = truth.clone();
        for (i, pose) in estimate.poses.iter_mut().enumerate() {
            pose.world_from_camera.translation.vector.y += 0.001 * (i / 2) as f64 * if i % 2 == 0 { 1.0 } else { -1.0 };
        }
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap();
        let residual = |i: usize| {
            let moved = moved(&errors.alignment, &estimate.poses[i].world_from_camera.translation.vector);
            (moved - truth.poses[i].world_from_camera.translation.vector).norm()
        };
        let mut residuals: Vec<f64> = (0..9).map(residual).collect();
        residuals.sort_by(f64::total_cmp);
        assert_eq!((errors.ate_median_m, errors.ate_max_m), (residuals[4], residuals[8]));
        assert!(residuals[4] > residuals[1] && residuals[4] < residuals[8]);
    }

    #[test]
    fn rotation_is_divided_by_frames_and_seconds() {
        // The estimate turns by half a degree a frame of 0.1 s, and every other frame has no truth. One stamp is out of step.
        let turned = |t: f64| StampedPose {
            timestamp_s: t,
            world_from_camera: se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, (5.0 * t).to_radians())),
        };
        let still = |t: f64| StampedPose { timestamp_s: t, world_from_camera: Se3::identity() };
        let mut estimate = Trajectory { poses: (0..41).map(|i| turned(0.1 * f64::from(i))).collect() };
        estimate.poses.push(turned(14.0));
        let truth = Trajectory { poses: (0..41).step_by(2).map(|i| still(0.1 * f64::from(i))).collect() };
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap().rpe;
        assert!((errors.rot_deg_per_step - 1.0).abs() < 1e-9, "{errors:?}");
        assert!((errors.rot_deg_per_frame - 0.5).abs() < 1e-9, "{errors:?}");
        assert!((errors.rot_deg_per_s - 5.0).abs() < 1e-9, "{errors:?}");
    }

    #[test]
    fn the_usual_period_is_the_median() {
        assert_eq!(median_period_s(&path([0.0, 0.125, 0.5, 1.0, 1.5])), 0.5);
        assert_eq!(median_period_s(&path([0.0, 0.5, 0.625, 2.0])), 0.5);
        assert_eq!(median_period_s(&path([1.0])), f64::INFINITY);
    }

    #[test]
    fn a_pose_of_the_truth_that_serves_twice_is_no_step() {
        let truth = path([0.0, 0.1, 0.2, 0.3]);
        let estimate = path([0.0, 0.1, 0.11, 0.2]);
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Rigid).unwrap();
        assert_eq!((errors.pairs, errors.rpe.steps), (4, 2));
    }
}
