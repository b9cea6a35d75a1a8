//! A measured pose of one camera relative to another, as a factor of bundle adjustment.
//!
//! Its error is `Log(current · reference⁻¹ · measured⁻¹)`, whose Jacobian by a left perturbation of the current pose is the identity for small
//! errors, and by one of the reference the negative adjoint (Solà, *A micro Lie theory*, 2018). Huber's kernel bounds the pull of a false one.

use nalgebra::{Matrix6, Vector6};

use crate::geometry::{Se3, se3};
use crate::tracking::solvers::pose::PosePrior;

/// Squared error, whitened, beyond which it pulls less and less: 95% of six coordinates are below.
const HUBER_SQUARED: f64 = 12.592;

/// Pose of the camera `current` relative to `reference`, both places in a list of poses.
#[derive(Clone, Copy, Debug)]
pub struct RelativePose {
    pub current: usize,
    pub reference: usize,
    pub current_from_reference: Se3,
    /// Of a left perturbation (metres, radians).
    pub information: Matrix6<f64>,
}

/// Its terms of the normal equations.
pub struct RelativeTerms {
    pub current: (Matrix6<f64>, Vector6<f64>),
    pub reference: (Matrix6<f64>, Vector6<f64>),
    /// Rows of the current pose, columns of the reference.
    pub mixed: Matrix6<f64>,
}

impl RelativePose {
    /// What it says of the current pose, given that of the reference.
    pub fn prior(&self, reference_from_world: &Se3) -> PosePrior {
        PosePrior { camera_from_world: self.current_from_reference * reference_from_world, information: self.information }
    }

    fn error(&self, poses: &[Se3]) -> Vector6<f64> {
        let found = poses[self.current] * poses[self.reference].inverse();
        se3::log(&(found * self.current_from_reference.inverse()))
    }

    /// Cost of an error and the weight of its square.
    fn robust(&self, error: &Vector6<f64>) -> (f64, f64) {
        let squared = error.dot(&(self.information * error));
        if squared <= HUBER_SQUARED {
            return (squared, 1.0);
        }
        (2.0 * (HUBER_SQUARED * squared).sqrt() - HUBER_SQUARED, (HUBER_SQUARED / squared).sqrt())
    }

    /// Robust cost, in squared standard deviations.
    pub fn cost(&self, poses: &[Se3]) -> f64 {
        self.robust(&self.error(poses)).0
    }

    /// Gauss-Newton terms at the poses.
    pub fn linearise(&self, poses: &[Se3]) -> RelativeTerms {
        let error = self.error(poses);
        let information = self.information * self.robust(&error).1;
        let by_reference = -se3::adjoint(&(poses[self.current] * poses[self.reference].inverse()));
        let weighted = by_reference.transpose() * information;
        RelativeTerms {
            current: (information, information * error),
            reference: (weighted * by_reference, weighted * error),
            mixed: information * by_reference,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn factor() -> (RelativePose, [Se3; 2]) {
        let poses =
            [se3::exp(&Vector6::new(0.4, -0.2, 1.1, 0.3, -0.5, 0.2)), se3::exp(&Vector6::new(-0.3, 0.6, 0.2, 0.1, 0.4, -0.3))];
        let half = Matrix6::from_fn(|i, j| ((3 * i + 7 * j) % 5) as f64);
        let information = (half * half.transpose() + Matrix6::identity()) * 1e4;
        let current_from_reference = poses[0] * poses[1].inverse();
        (RelativePose { current: 0, reference: 1, current_from_reference, information }, poses)
    }

    fn moved(poses: &[Se3; 2], which: usize, axis: usize, by: f64) -> [Se3; 2] {
        let mut tau = Vector6::zeros();
        tau[axis] = by;
        let mut poses = *poses;
        poses[which] = se3::exp(&tau) * poses[which];
        poses
    }

    #[test]
    fn gradients_and_curvature_are_those_of_the_cost() {
        let (factor, truth) = factor();
        let near = [truth[0], se3::exp(&Vector6::new(1e-4, -2e-4, 1e-4, 1e-4, 0.5e-4, -1e-4)) * truth[1]];
        let terms = factor.linearise(&near);
        const STEP: f64 = 1e-6;
        for (which, (_, gradient)) in [(0, terms.current), (1, terms.reference)] {
            for axis in 0..6 {
                let at = |by| factor.cost(&moved(&near, which, axis, by));
                let slope = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                assert!(
                    (slope - 2.0 * gradient[axis]).abs() < 2e-3 * gradient.norm(),
                    "{which} {axis}: {slope} {}",
                    gradient[axis]
                );
            }
        }
        // The curvature along one axis of each pose at once, at the measurement.
        let terms = factor.linearise(&truth);
        for (a, b) in [(0, 3), (4, 1), (5, 5)] {
            let at = |by| factor.cost(&moved(&moved(&truth, 0, a, by), 1, b, by));
            let expected = terms.current.0[(a, a)] + terms.reference.0[(b, b)] + 2.0 * terms.mixed[(a, b)];
            let found = at(1e-5) / 1e-10;
            assert!((found - expected).abs() < 1e-3 * terms.current.0.norm(), "{a} {b}: {found} {expected}");
        }
    }

    #[test]
    fn a_false_one_pulls_no_more_than_its_threshold() {
        let (factor, truth) = factor();
        let pull = |off: f64| {
            let terms = factor.linearise(&moved(&truth, 0, 2, off));
            (terms.current.1.dot(&(factor.information.try_inverse().unwrap() * terms.current.1))).sqrt()
        };
        assert!((pull(1e-3) / pull(5e-4) - 2.0).abs() < 1e-6);
        assert!((pull(1.0) - HUBER_SQUARED.sqrt()).abs() < 1e-6 && (pull(3.0) - HUBER_SQUARED.sqrt()).abs() < 1e-6);
    }
}
