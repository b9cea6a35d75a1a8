//! Camera paths of a run, for pictures of its map.

use nalgebra::{Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3, Vector4};

use crate::geometry::{Se3, StampedPose, Trajectory};

/// Hand tremor is smoothed away over about so many seconds.
const TREMOR_S: f64 = 0.25;
/// Gaussians beyond so many standard deviations have no weight.
const TAILS: f64 = 3.0;
/// Keyframes that look at one thing from more than this share of the directions around it are circled, else passed in front of.
const AROUND: f64 = 0.6;
/// Of a pass in front: width of the ellipse as a share of the distance, and its height.
const SWAY: (f64, f64) = (0.12, 0.05);

/// A camera path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum CameraPathKind {
    /// Around what the camera looked at.
    Orbit,
    /// As the camera moved, without tremor.
    Trajectory,
    /// From keyframe to keyframe at an even pace.
    Keyframes,
}

/// So many poses along a path, world from camera; none without poses.
pub fn poses(kind: CameraPathKind, trajectory: &Trajectory, keyframes: &Trajectory, count: usize) -> Vec<Se3> {
    let known = if keyframes.poses.is_empty() { trajectory } else { keyframes };
    match kind {
        CameraPathKind::Trajectory => along(&trajectory.poses, count),
        CameraPathKind::Keyframes => through(&known.poses, count),
        CameraPathKind::Orbit => around(&known.poses, count),
    }
}

/// Shares of the way from 0 to 1.
fn shares(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |k| k as f64 / (count.max(2) - 1) as f64)
}

/// Weighted means of the poses around even times.
fn along(poses: &[StampedPose], count: usize) -> Vec<Se3> {
    let Some((first, last)) = poses.first().zip(poses.last()) else { return Vec::new() };
    let at = |share: f64| {
        let t = first.timestamp_s + share * (last.timestamp_s - first.timestamp_s);
        let start = poses.partition_point(|pose| pose.timestamp_s < t - TAILS * TREMOR_S);
        let end = poses.partition_point(|pose| pose.timestamp_s <= t + TAILS * TREMOR_S);
        if start == end {
            // In a gap of the path the nearest pose stands.
            let after = start.min(poses.len() - 1);
            let away = |k: usize| (poses[k].timestamp_s - t).abs();
            let before = after.saturating_sub(1);
            return poses[if away(before) < away(after) { before } else { after }].world_from_camera;
        }
        let near = start..end;
        mean(poses[near].iter().map(|pose| {
            let off = (pose.timestamp_s - t) / TREMOR_S;
            ((-0.5 * off * off).exp(), pose.world_from_camera)
        }))
    };
    shares(count).map(at).collect()
}

/// Weighted mean of poses near each other.
fn mean(poses: impl Iterator<Item = (f64, Se3)>) -> Se3 {
    let (mut weight, mut position, mut rotation) = (0.0, Vector3::zeros(), Vector4::zeros());
    for (w, pose) in poses {
        let q = pose.rotation.coords;
        weight += w;
        position += w * pose.translation.vector;
        rotation += if q.dot(&rotation) < 0.0 { -w * q } else { w * q };
    }
    let rotation = UnitQuaternion::new_normalize(Quaternion::from_vector(rotation));
    Se3::from_parts(Translation3::from(position / weight.max(f64::MIN_POSITIVE)), rotation)
}

/// A Catmull-Rom spline through all poses; rotations by the shortest way.
fn through(poses: &[StampedPose], count: usize) -> Vec<Se3> {
    if poses.is_empty() {
        return Vec::new();
    }
    let at = |place: isize| &poses[place.clamp(0, poses.len() as isize - 1) as usize].world_from_camera;
    let spline = |share: f64| {
        let along = share * (poses.len() - 1) as f64;
        let (k, u) = (along.floor() as isize, along.fract());
        let [a, b, c, d] = [at(k - 1), at(k), at(k + 1), at(k + 2)].map(|pose| pose.translation.vector);
        let position = b + 0.5 * u * (c - a + u * (2.0 * a - 5.0 * b + 4.0 * c - d + u * (3.0 * (b - c) + d - a)));
        let (from, to) = (at(k).rotation, at(k + 1).rotation);
        let rotation = from.try_slerp(&to, u, 1e-9).unwrap_or(to);
        Se3::from_parts(Translation3::from(position), rotation)
    };
    shares(count).map(spline).collect()
}

/// A circle around the point that the cameras look at, if they do so from most sides; else an ellipse in front of the middle camera.
fn around(poses: &[StampedPose], count: usize) -> Vec<Se3> {
    if poses.is_empty() {
        return Vec::new();
    }
    let cameras: Vec<Se3> = poses.iter().map(|pose| pose.world_from_camera).collect();
    let up = -cameras.iter().map(|pose| pose.rotation * Vector3::y()).sum::<Vector3<f64>>();
    let up = up.try_normalize(1e-9).unwrap_or_else(|| -Vector3::y());
    let middle = cameras[cameras.len() / 2];
    let focus = focus(&cameras).unwrap_or_else(|| middle.translation.vector + middle.rotation * Vector3::z());
    let turns = |k: usize| std::f64::consts::TAU * k as f64 / count as f64;
    let offsets: Vec<Vector3<f64>> = cameras.iter().map(|pose| pose.translation.vector - focus).collect();
    let flat = |offset: &Vector3<f64>| offset - up * offset.dot(&up);
    let directions = offsets.iter().filter_map(|offset| flat(offset).try_normalize(1e-9)).sum::<Vector3<f64>>();
    if directions.norm() / (offsets.len() as f64) < 1.0 - AROUND {
        let mean = |of: &dyn Fn(&Vector3<f64>) -> f64| offsets.iter().map(of).sum::<f64>() / offsets.len() as f64;
        let (radius, height) = (mean(&|o| flat(o).norm()), mean(&|o| o.dot(&up)));
        let start = flat(&offsets[0]).try_normalize(1e-9).unwrap_or_else(|| middle.rotation * Vector3::x());
        let side = up.cross(&start);
        let at = |k: usize| focus + up * height + radius * (turns(k).cos() * start + turns(k).sin() * side);
        return (0..count).map(|k| looking(at(k), focus, up)).collect();
    }
    let (right, back) = (middle.rotation * Vector3::x(), middle.translation.vector - focus);
    let sway = |k: usize| right * (SWAY.0 * turns(k).sin()) + up * (SWAY.1 * turns(k).cos());
    (0..count).map(|k| looking(focus + back + sway(k) * back.norm(), focus, up)).collect()
}

/// The point nearest to all optical axes, if they nearly meet in front of the cameras.
fn focus(cameras: &[Se3]) -> Option<Vector3<f64>> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for camera in cameras {
        let axis = camera.rotation * Vector3::z();
        let across = Matrix3::identity() - axis * axis.transpose();
        normal += across;
        right += across * camera.translation.vector;
    }
    let eigen = normal.symmetric_eigenvalues();
    let is_definite = eigen.min() > 1e-3 * eigen.max();
    let focus = is_definite.then(|| normal.lu().solve(&right)).flatten()?;
    let ahead = |camera: &&Se3| (camera.rotation * Vector3::z()).dot(&(focus - camera.translation.vector)) > 0.0;
    (2 * cameras.iter().filter(ahead).count() > cameras.len()).then_some(focus)
}

/// A camera at a point that looks at another one.
fn looking(from: Vector3<f64>, at: Vector3<f64>, up: Vector3<f64>) -> Se3 {
    let forward = (at - from).try_normalize(1e-12).unwrap_or_else(Vector3::z);
    let right = forward.cross(&up).try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, forward.cross(&right), forward]));
    Se3::from_parts(Translation3::from(from), UnitQuaternion::from_rotation_matrix(&rotation))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trajectory(poses: impl Iterator<Item = Se3>) -> Trajectory {
        let stamped = |(k, world_from_camera): (usize, Se3)| StampedPose { timestamp_s: k as f64 * 0.1, world_from_camera };
        Trajectory { poses: poses.enumerate().map(stamped).collect() }
    }

    /// Cameras on a circle of 2 m around a point at half of their height, with tremor.
    fn circle(turn: f64) -> Trajectory {
        let focus = Vector3::new(1.0, 2.0, 3.0);
        trajectory((0..60).map(move |k| {
            let angle = turn * f64::from(k) / 60.0;
            let tremor = if k % 2 == 0 { 0.01 } else { -0.01 };
            let from = focus + Vector3::new(2.0 * angle.cos(), -0.5 + tremor, 2.0 * angle.sin());
            looking(from, focus, -Vector3::y())
        }))
    }

    #[test]
    fn an_orbit_circles_what_the_cameras_look_at() {
        let poses = poses(CameraPathKind::Orbit, &Trajectory::default(), &circle(std::f64::consts::TAU), 40);
        let focus = Vector3::new(1.0, 2.0, 3.0);
        assert_eq!(poses.len(), 40);
        for pose in &poses {
            let offset = pose.translation.vector - focus;
            assert!((offset.xz().norm() - 2.0).abs() < 0.02 && (offset.y + 0.5).abs() < 0.02, "{offset}");
            assert!((pose.rotation * Vector3::z()).dot(&-offset.normalize()) > 0.999);
            assert!((pose.rotation * Vector3::y()).y > 0.9, "upright");
        }
    }

    #[test]
    fn cameras_on_one_side_are_not_left() {
        let keyframes = circle(0.6);
        let middle = keyframes.poses[30].world_from_camera.translation.vector;
        for pose in poses(CameraPathKind::Orbit, &Trajectory::default(), &keyframes, 16) {
            assert!((pose.translation.vector - middle).norm() < 0.4);
        }
    }

    #[test]
    fn a_trajectory_loses_its_tremor_and_keeps_its_ends() {
        let shaken = circle(3.0);
        let smooth = poses(CameraPathKind::Trajectory, &shaken, &Trajectory::default(), 60);
        for (pose, original) in smooth.iter().zip(&shaken.poses).skip(10).take(40) {
            let off = pose.translation.vector - original.world_from_camera.translation.vector;
            assert!((pose.translation.vector.y - 1.5).abs() < 2e-3 && off.xz().norm() < 0.02, "{off}");
        }
        let through = poses(CameraPathKind::Keyframes, &Trajectory::default(), &shaken, 60);
        for (pose, original) in through.iter().zip(&shaken.poses) {
            assert!((pose.inverse() * original.world_from_camera).translation.vector.norm() < 1e-9);
        }
    }

    #[test]
    fn a_gap_of_the_path_is_bridged() {
        let mut broken = circle(1.0);
        broken.poses.iter_mut().skip(30).for_each(|pose| pose.timestamp_s += 100.0);
        let path = poses(CameraPathKind::Trajectory, &broken, &Trajectory::default(), 200);
        let known =
            |pose: &Se3| broken.poses.iter().any(|k| (k.world_from_camera.inverse() * pose).translation.vector.norm() < 0.1);
        assert!(path.iter().all(known));
    }

    #[test]
    fn few_poses_give_paths_too() {
        let one = trajectory(std::iter::once(Se3::translation(1.0, 0.0, 0.0)));
        for kind in [CameraPathKind::Orbit, CameraPathKind::Trajectory, CameraPathKind::Keyframes] {
            assert!(poses(kind, &Trajectory::default(), &Trajectory::default(), 5).is_empty());
            let path = poses(kind, &one, &one, 5);
            assert!(path.len() == 5 && path.iter().all(|pose| pose.translation.vector.iter().all(|v| v.is_finite())), "{kind:?}");
        }
    }
}
