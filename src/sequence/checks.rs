//! What several layouts check: whether numbers from a file make a camera, and whether they make a rigid motion.

use nalgebra::{Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};

use crate::geometry::{Camera, Se3};

/// The largest side of an image that a calibration may claim, pixels.
const MAX_SIDE: u32 = 65_536;
/// How far `R Rᵀ` may be from the identity: files print few digits.
const ORTHONORMAL: f64 = 1e-2;

/// The camera, if its numbers are finite and its size, focal lengths and depth units positive.
pub fn camera(camera: Camera) -> Result<Camera, String> {
    let (p, d) = (&camera.pinhole, &camera.distortion);
    let finite = [p.fx, p.fy, p.cx, p.cy, d.k1, d.k2, d.p1, d.p2, d.k3].iter().all(|v| v.is_finite());
    let positive = [p.fx, p.fy, camera.depth_units_per_metre].iter().all(|v| *v > 0.0 && v.is_finite());
    let sized = [p.width, p.height].iter().all(|side| (1..=MAX_SIDE).contains(side));
    if finite && positive && sized {
        Ok(camera)
    } else {
        Err("a camera needs finite numbers, and positive focal lengths, size (at most 65536 pixels a side) and depth units"
            .into())
    }
}

/// An image's side as files hold it, `None` where it is no size.
pub fn side(pixels: u64) -> Option<u32> {
    u32::try_from(pixels).ok().filter(|side| (1..=MAX_SIDE).contains(side))
}

/// So many finite numbers, and nothing else.
pub fn numbers(text: &str, count: usize) -> Result<Vec<f64>, String> {
    let finite = |field: &str| field.parse().ok().filter(|v: &f64| v.is_finite());
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(finite).collect();
    let of_that_count = numbers.filter(|numbers| numbers.len() == count);
    of_that_count.ok_or_else(|| format!("expected {count} finite numbers, not `{}`", text.trim()))
}

/// The rigid motion whose 3×4 matrix the first twelve numbers are, row-major, metres.
pub fn rigid(m: &[f64]) -> Result<Se3, String> {
    if m.len() < 12 || m.iter().any(|v| !v.is_finite()) {
        return Err("a pose needs three rows of four finite numbers".into());
    }
    let rotation = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
    if (rotation * rotation.transpose() - Matrix3::identity()).norm() > ORTHONORMAL || rotation.determinant() < 0.0 {
        return Err("the first three columns are no rotation".into());
    }
    // In closed form, then normalised: the nearest rotation takes an iteration and is no better at this distance.
    let quaternion = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation)).into_inner();
    Ok(Se3::from_parts(Translation3::new(m[3], m[7], m[11]), UnitQuaternion::new_normalize(quaternion)))
}

/// The rigid motion of a translation (metres) and a quaternion `w x y z` of any length but zero.
pub fn rigid_of_quaternion(translation: [f64; 3], [w, x, y, z]: [f64; 4]) -> Result<Se3, String> {
    let quaternion = Quaternion::new(w, x, y, z);
    let finite = translation.iter().chain(quaternion.coords.iter()).all(|v| v.is_finite());
    if !finite || quaternion.norm_squared() < 1e-8 {
        return Err("a pose needs finite numbers and a quaternion with a length".into());
    }
    let translation = Translation3::from(Vector3::from(translation));
    Ok(Se3::from_parts(translation, UnitQuaternion::from_quaternion(quaternion)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Distortion, Pinhole, se3};

    #[test]
    fn a_matrix_and_a_quaternion_give_the_motion_that_they_were_made_of() {
        for angle in [0.0, 1.0, 3.0, std::f64::consts::PI] {
            let expected = se3::exp(&nalgebra::Vector6::new(1.0, -2.0, 3.0, 0.6 * angle, 0.0, -0.8 * angle));
            let rows: Vec<f64> = expected.to_homogeneous().transpose().iter().copied().collect();
            let q = expected.rotation.quaternion();
            let t = expected.translation.vector;
            let of_quaternion = rigid_of_quaternion(t.into(), [-2.0 * q.w, -2.0 * q.i, -2.0 * q.j, -2.0 * q.k]).unwrap();
            for found in [rigid(&rows).unwrap(), of_quaternion] {
                assert!((found.to_homogeneous() - expected.to_homogeneous()).norm() < 1e-9, "at {angle} rad");
            }
        }
    }

    #[test]
    fn what_is_no_motion_or_no_camera_is_refused() {
        assert!(rigid(&[1.0; 11]).is_err());
        assert!(rigid(&[0.0; 12]).is_err());
        assert!(rigid(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0]).is_err(), "a mirror");
        assert!(rigid(&[1.0, 0.0, 0.0, f64::NAN, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]).is_err());
        assert!(rigid_of_quaternion([0.0; 3], [0.0; 4]).is_err());
        let pinhole = Pinhole { fx: 5.0, fy: 5.0, cx: 1.0, cy: 1.0, width: 4, height: 4 };
        let with =
            |pinhole, depth_units_per_metre| camera(Camera { pinhole, distortion: Distortion::default(), depth_units_per_metre });
        assert!(with(pinhole, 1.0).is_ok());
        assert!(with(pinhole, 0.0).is_err() && with(pinhole, f64::INFINITY).is_err());
        assert!(with(Pinhole { fx: f64::NAN, ..pinhole }, 1.0).is_err());
        assert!(with(Pinhole { height: 0, ..pinhole }, 1.0).is_err());
    }
}
