//! Maps in the axes of graphics: x right, y up, z backward. Ours have y down and z forward, as 3DGS' PLY.

use glam::{Quat, Vec3};

use crate::splat::GaussianCloud;

/// Signs of the harmonics when y and z change theirs, in 3DGS' order.
const SIGNS: [f32; 16] = [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

/// The map turned by half a turn about x; the same turn leads back.
pub(super) fn turned(cloud: &GaussianCloud) -> GaussianCloud {
    let mut turned = cloud.clone();
    turned.means.iter_mut().for_each(|mean| *mean *= Vec3::new(1.0, -1.0, -1.0));
    for rotation in &mut turned.rotations {
        let [x, y, z, w] = rotation.to_array();
        // Half a turn about x, times the rotation, times half a turn back: the Gaussian's own axes turn along, and its extents stay.
        *rotation = Quat::from_xyzw(x, -y, -z, w);
    }
    let coefficients = cloud.sh_degree.coefficients();
    for sh in turned.sh.chunks_mut(coefficients) {
        sh.iter_mut().zip(SIGNS).for_each(|(coefficient, sign)| *coefficient *= sign);
    }
    turned
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::super::tests::cloud;
    use super::*;
    use crate::splat::ShDegree;
    use crate::splat::sh::ShRotation;

    #[test]
    fn a_turn_is_that_of_rotations_and_harmonics() {
        let original = cloud(ShDegree::ALL[3], 20);
        let turned = turned(&original);
        let half = UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI);
        let rotation = ShRotation::new(&half);
        for i in 0..original.len() {
            let (before, after) = (original.get(i), turned.get(i));
            let covariance = |q: Quat, log_scale: Vec3| {
                let axes = glam::Mat3::from_quat(q.normalize()) * glam::Mat3::from_diagonal(log_scale.exp());
                axes * axes.transpose()
            };
            let turn = glam::Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
            assert!(after.mean.distance(turn * before.mean) < 1e-6);
            let expected = turn * covariance(before.rotation, before.log_scale) * turn.transpose();
            assert!((covariance(after.rotation, after.log_scale) - expected).to_cols_array().iter().all(|v| v.abs() < 1e-6));
            let mut sh: Vec<Vector3<f64>> = before.sh.iter().map(|c| Vector3::from(c.to_array().map(f64::from))).collect();
            rotation.rotate(&mut sh);
            sh.iter()
                .zip(&after.sh)
                .for_each(|(a, b)| assert!((a.map(|v| v as f32) - Vector3::from(b.to_array())).norm() < 1e-5));
        }
        assert_eq!(super::turned(&turned), original);
    }
}
