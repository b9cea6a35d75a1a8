//! SE(3) and its exponential map.
//!
//! Transforms read `a_from_b`. A tangent vector is `τ = (ρ, θ)`, translation first, and perturbs from the left: `T ← Exp(τ)·T`
//! (Barfoot, *State Estimation for Robotics*, ch. 7; Solà, *A micro Lie theory*, 2018).

use nalgebra::{Isometry3, Matrix3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

/// A rigid motion; its action is `p_in_a = a_from_b * p_in_b`, metres.
pub type Se3 = Isometry3<f64>;

/// Below this angle (rad) the series are exact to f64; far below it, the closed forms lose all digits to cancellation.
const SMALL_ANGLE_RAD: f64 = 1e-2;

/// The matrix of the cross product, `skew(a) * b = a × b`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// `Exp: R⁶ → SE(3)` of `τ = (ρ, θ)`, metres and radians.
pub fn exp(tau: &Vector6<f64>) -> Se3 {
    let rho: Vector3<f64> = tau.fixed_rows::<3>(0).into_owned();
    let theta: Vector3<f64> = tau.fixed_rows::<3>(3).into_owned();
    let translation = left_jacobian(&theta) * rho;
    Isometry3::from_parts(Translation3::from(translation), UnitQuaternion::from_scaled_axis(theta))
}

/// `Log: SE(3) → R⁶`, the inverse of [`exp`] for rotation angles below π.
pub fn log(a_from_b: &Se3) -> Vector6<f64> {
    let theta = a_from_b.rotation.scaled_axis();
    let rho = left_jacobian_inverse(&theta) * a_from_b.translation.vector;
    Vector6::new(rho.x, rho.y, rho.z, theta.x, theta.y, theta.z)
}

/// The adjoint of a motion: `T·Exp(τ) = Exp(adjoint(T)·τ)·T`.
pub fn adjoint(a_from_b: &Se3) -> Matrix6<f64> {
    let rotation = *a_from_b.rotation.to_rotation_matrix().matrix();
    let mut adjoint = Matrix6::zeros();
    adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    adjoint.fixed_view_mut::<3, 3>(0, 3).copy_from(&(skew(&a_from_b.translation.vector) * rotation));
    adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    adjoint
}

/// The left Jacobian of SO(3), `V(θ)`.
fn left_jacobian(theta: &Vector3<f64>) -> Matrix3<f64> {
    let angle = theta.norm();
    let w = skew(theta);
    let (a, b) = if angle < SMALL_ANGLE_RAD {
        let square = angle * angle;
        (0.5 - square / 24.0 + square * square / 720.0, 1.0 / 6.0 - square / 120.0 + square * square / 5040.0)
    } else {
        (2.0 * ((0.5 * angle).sin() / angle).powi(2), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + w * a + w * w * b
}

fn left_jacobian_inverse(theta: &Vector3<f64>) -> Matrix3<f64> {
    let angle = theta.norm();
    let w = skew(theta);
    let c = if angle < SMALL_ANGLE_RAD {
        let square = angle * angle;
        1.0 / 12.0 + square / 720.0 + square * square / 30240.0
    } else {
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / angle.powi(2)
    };
    Matrix3::identity() - w * 0.5 + w * w * c
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn exp_and_log_are_inverse(t in prop::array::uniform3(-10.0f64..10.0), axis in prop::array::uniform3(-1.0f64..1.0), angle in 0.0f64..3.1) {
            let axis = Vector3::from(axis);
            prop_assume!(axis.norm() > 1e-3);
            let theta = axis.normalize() * angle;
            let tau = Vector6::new(t[0], t[1], t[2], theta.x, theta.y, theta.z);
            prop_assert!((log(&exp(&tau)) - tau).norm() < 1e-8 * (1.0 + tau.norm()));
        }

        #[test]
        fn tiny_rotations_keep_full_precision(t in prop::array::uniform3(-10.0f64..10.0), r in prop::array::uniform3(-1e-6f64..1e-6)) {
            let tau = Vector6::new(t[0], t[1], t[2], r[0], r[1], r[2]);
            prop_assert!((log(&exp(&tau)) - tau).norm() < 1e-12);
        }
    }

    #[test]
    fn no_angle_loses_precision() {
        let axis = Vector3::new(0.2, -0.7, 0.5).normalize();
        for angle in (0..120).map(|k| 1e-12 * 10f64.powf(0.1 * f64::from(k))).chain([0.0]) {
            let theta = axis * angle;
            let tau = Vector6::new(7.0, -3.0, 9.0, theta.x, theta.y, theta.z);
            let error = (log(&exp(&tau)) - tau).norm();
            assert!(error < 1e-13, "{angle}: {error}");
        }
    }

    #[test]
    fn exp_is_the_matrix_exponential() {
        let tau = Vector6::new(0.3, -0.2, 0.5, 0.4, 0.1, -0.7);
        let mut generator = nalgebra::Matrix4::zeros();
        generator.fixed_view_mut::<3, 3>(0, 0).copy_from(&skew(&Vector3::new(0.4, 0.1, -0.7)));
        generator.fixed_view_mut::<3, 1>(0, 3).copy_from(&Vector3::new(0.3, -0.2, 0.5));
        let mut series = nalgebra::Matrix4::identity();
        let mut term = nalgebra::Matrix4::identity();
        for k in 1..30 {
            term = term * generator / f64::from(k);
            series += term;
        }
        assert!((exp(&tau).to_homogeneous() - series).norm() < 1e-13);
    }
}
