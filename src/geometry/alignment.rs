//! The motion between two sets of paired points, in closed form: Umeyama, *Least-squares estimation of transformation parameters
//! between two point patterns*, 1991, solved with Horn's unit quaternion (1987), which has no reflections to rule out.

use nalgebra::{Matrix3, Matrix4, Quaternion, UnitQuaternion, Vector3};

use super::Sim3;

/// The motion that brings `from` closest to `to` in the least-squares sense, `[N, 3]`, point `i` to point `i`; its scale is 1 unless
/// `scale_is_free`. `None` without points, or if the scale is free and all points coincide.
///
/// Points on one line leave the rotation about it open; the smallest distance is the same for each choice.
pub fn align(from: &[Vector3<f64>], to: &[Vector3<f64>], scale_is_free: bool) -> Option<Sim3> {
    if from.is_empty() || from.len() != to.len() {
        return None;
    }
    let mean = |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let (mean_from, mean_to) = (mean(from), mean(to));
    let mut moments = Matrix3::zeros();
    let (mut spread_from, mut spread_to) = (0.0, 0.0);
    for (a, b) in from.iter().zip(to) {
        let (a, b) = (a - mean_from, b - mean_to);
        moments += a * b.transpose();
        spread_from += a.norm_squared();
        spread_to += b.norm_squared();
    }
    let rotation = best_rotation(&moments);
    let scale = if !scale_is_free {
        1.0
    } else if spread_from > 0.0 && spread_to > 0.0 {
        (rotation.to_rotation_matrix().matrix() * moments).trace() / spread_from
    } else {
        return None;
    };
    Some(Sim3 { rotation, translation: mean_to - rotation * mean_from * scale, scale })
}

/// The rotation `R` that maximises `Σ bᵀ R a` for `moments = Σ a bᵀ`: the eigenvector of Horn's symmetric matrix that belongs to
/// its largest eigenvalue, read as a quaternion.
fn best_rotation(moments: &Matrix3<f64>) -> UnitQuaternion<f64> {
    let skewed =
        Vector3::new(moments[(1, 2)] - moments[(2, 1)], moments[(2, 0)] - moments[(0, 2)], moments[(0, 1)] - moments[(1, 0)]);
    let mut horn = Matrix4::zeros();
    horn[(0, 0)] = moments.trace();
    horn.fixed_view_mut::<1, 3>(0, 1).copy_from(&skewed.transpose());
    horn.fixed_view_mut::<3, 1>(1, 0).copy_from(&skewed);
    let symmetric = moments + moments.transpose() - Matrix3::identity() * moments.trace();
    horn.fixed_view_mut::<3, 3>(1, 1).copy_from(&symmetric);
    let eigen = horn.symmetric_eigen();
    let q = eigen.eigenvectors.column(eigen.eigenvalues.imax());
    UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]))
}

#[cfg(test)]
mod tests {
    use super::super::sim3::{self, Vector7};
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_moved_set_is_aligned_exactly_and_no_small_motion_beats_the_best_one(
            tau in prop::array::uniform7(-0.8f64..0.8), nudge in prop::array::uniform7(-0.1f64..0.1), seed in 0u64..1000, scale_is_free: bool
        ) {
            let mut rng = fastrand::Rng::with_seed(seed);
            let mut point = || Vector3::from_fn(|_, _| rng.f64());
            let from: Vec<_> = (0..6).map(|_| point()).collect();
            let frozen = |mut tau: Vector7| { tau[6] *= f64::from(u8::from(scale_is_free)); sim3::exp(&tau) };
            let moved = frozen(Vector7::from(tau));
            let apply = |s: &Sim3, p: &Vector3<f64>| s.act(&(*p).into()).coords;
            let exact: Vec<_> = from.iter().map(|p| apply(&moved, p)).collect();
            let found = align(&from, &exact, scale_is_free).unwrap();
            prop_assert!(sim3::log(&(found * moved.inverse())).norm() < 1e-6);
            let noisy: Vec<_> = exact.iter().map(|p| p + point() * 0.3).collect();
            let best = align(&from, &noisy, scale_is_free).unwrap();
            let cost = |s: &Sim3| from.iter().zip(&noisy).map(|(a, b)| (apply(s, a) - b).norm_squared()).sum::<f64>();
            prop_assert!(cost(&best) <= cost(&(frozen(Vector7::from(nudge)) * best)) + 1e-12);
        }
    }

    #[test]
    fn what_has_no_answer_gets_none() {
        let still = [Vector3::zeros(); 4];
        assert!(align(&still, &still, true).is_none() && align(&[], &[], false).is_none());
        assert_eq!(align(&still, &still, false).unwrap().translation, Vector3::zeros());
        let apart = [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::zeros()];
        assert!(align(&still, &apart, true).is_none() && align(&apart, &still, true).is_none());
        assert!(align(&apart, &apart[..3], false).is_none());
        // Also where that place is not the origin.
        let elsewhere = [Vector3::new(1.0, -2.0, 3.0); 4];
        assert!(align(&elsewhere, &apart, true).is_none() && align(&apart, &elsewhere, true).is_none());
    }
}
