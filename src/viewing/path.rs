//! The camera's path with its errors, and the true path, in the world of the map.

use nalgebra::{Point3, Vector3};

use super::protocol::CameraPath;
use crate::evaluation::{Comparison, MAX_TIME_DIFFERENCE_S};
use crate::geometry::{StampedPose, Trajectory, align};

/// The path of an estimate, thinned to so many poses, in hundredths of millimetres. Its comparison is in the world of the truth, and is brought to
/// that of the map.
pub fn camera_path(estimate: &Trajectory, compared: Option<&Comparison>, most: usize) -> CameraPath {
    let error_at = |t: f64| {
        let poses = &compared?.poses;
        let place = poses.partition_point(|pose| pose.timestamp_s < t - MAX_TIME_DIFFERENCE_S);
        poses.get(place).filter(|pose| (pose.timestamp_s - t).abs() <= MAX_TIME_DIFFERENCE_S)?.error_m
    };
    let pose = |pose: &StampedPose| {
        let [x, y, z] = rounded(pose.world_from_camera.translation.vector);
        (pose.timestamp_s, x, y, z, error_at(pose.timestamp_s))
    };
    let poses = thinned(&estimate.poses, most).map(pose).collect();
    CameraPath { poses, truth: compared.and_then(|compared| truth(estimate, compared, most)).unwrap_or_default() }
}

fn truth(estimate: &Trajectory, compared: &Comparison, most: usize) -> Option<Vec<[f64; 3]>> {
    if compared.truth.is_empty() || compared.poses.len() != estimate.poses.len() {
        return None;
    }
    let from: Vec<Vector3<f64>> = compared.poses.iter().map(|pose| pose.position.into()).collect();
    let to: Vec<Vector3<f64>> = estimate.poses.iter().map(|pose| pose.world_from_camera.translation.vector).collect();
    let map_from_truth = align(&from, &to, true)?;
    Some(thinned(&compared.truth, most).map(|point| rounded(map_from_truth.act(&Point3::from(*point)).coords)).collect())
}

fn thinned<T>(all: &[T], most: usize) -> impl Iterator<Item = &T> {
    all.iter().step_by(all.len().div_ceil(most).max(1))
}

fn rounded(point: Vector3<f64>) -> [f64; 3] {
    point.map(|v| (v * 1e5).round() / 1e5).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::{Alignment, evaluate_trajectory};
    use crate::geometry::Se3;

    #[test]
    fn the_truth_lies_beside_the_path_that_it_is_compared_with() {
        let path = |scale: f64, noise: f64| {
            let pose = |k: usize| {
                let (t, off) = (0.1 * k as f64, if k.is_multiple_of(2) { noise } else { -noise });
                StampedPose {
                    timestamp_s: t,
                    world_from_camera: Se3::translation(scale * t.cos() + off, scale * t.sin(), scale * t),
                }
            };
            Trajectory { poses: (0..50).map(pose).collect() }
        };
        let (truth, estimate) = (path(1.0, 0.0), path(2.0, 0.02));
        let errors = evaluate_trajectory(&truth, &estimate, Alignment::Similarity).unwrap();
        let compared = Comparison::of(&estimate, Some((&truth, &errors)));
        let found = camera_path(&estimate, Some(&compared), 50);
        assert_eq!((found.poses.len(), found.truth.len()), (50, 50));
        for ((_, x, y, z, error), truth) in found.poses.iter().zip(&found.truth) {
            let off = (Vector3::new(*x, *y, *z) - Vector3::from(*truth)).norm();
            assert!((off - 0.02).abs() < 2e-3, "in the unit of the map: {off}");
            assert!((error.unwrap() - 0.01).abs() < 1e-3, "in that of the truth");
        }
        let alone = camera_path(&estimate, None, 50);
        assert!(alone.truth.is_empty() && alone.poses.iter().all(|pose| pose.4.is_none()));
    }
}
