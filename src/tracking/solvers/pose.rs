//! The pose of one camera from known points: robust Levenberg-Marquardt on SE(3) with a left perturbation.
//!
//! Several rounds; after each, every measurement is classified anew by χ² and may come back. Early rounds use Huber's kernel
//! (Mur-Artal & Tardós, *ORB-SLAM2*, 2017, sec. III-C). A measurement whose depth alone disagrees keeps its pixel.

use nalgebra::{Matrix6, Point3, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::tracking::solvers::pose_equations::{GroupedObservations, NormalEquations};
use crate::tracking::solvers::residual::{InlierClass, Measurement};

const ROUNDS: usize = 4;
const STEPS_PER_ROUND: usize = 8;
/// The last rounds run on inliers, without Huber's kernel.
const ROBUST_ROUNDS: usize = 2;
/// Steps below this (metres and radians together) have converged: in the last round, and in those before it.
const CONVERGED: f64 = 1e-7;
const NEARLY_CONVERGED: f64 = 1e-5;
/// Six unknowns need three pixels at least; with fewer measurements there is nothing to solve.
const MIN_OBSERVATIONS: usize = 3;

/// A known point and what was measured of it.
#[derive(Clone, Copy, Debug)]
pub struct PoseObservation {
    pub point_in_world: Point3<f64>,
    pub measurement: Measurement,
}

/// What is known of a pose beside the observations.
#[derive(Clone, Copy, Debug)]
pub struct PosePrior {
    pub camera_from_world: Se3,
    /// Of a left perturbation (metres, radians).
    pub information: Matrix6<f64>,
}

impl PosePrior {
    /// Gradient and cost at a pose near the prior's.
    fn pull(&self, pose: &Se3) -> (Vector6<f64>, f64) {
        let error = se3::log(&(pose * self.camera_from_world.inverse()));
        let gradient = self.information * error;
        (gradient, gradient.dot(&error))
    }
}

/// The result of [`optimise_pose`].
#[derive(Clone, Debug)]
pub struct PoseEstimate {
    pub camera_from_world: Se3,
    /// One per observation, in their order.
    pub classes: Vec<InlierClass>,
    pub inliers: usize,
}

/// The pose that explains the observations best, from `initial` (camera_from_world). Without enough to go by, `initial` comes back
/// with every observation an outlier.
pub fn optimise_pose(
    pinhole: &Pinhole,
    initial: &Se3,
    prior: Option<&PosePrior>,
    observations: &[PoseObservation],
) -> PoseEstimate {
    let mut pose = *initial;
    let mut classes: Vec<InlierClass> = observations
        .iter()
        .map(|o| if o.measurement.inverse_depth.is_some() { InlierClass::Full } else { InlierClass::PixelOnly })
        .collect();
    for round in 0..ROUNDS {
        if classes.iter().filter(|t| **t != InlierClass::Outlier).count() < MIN_OBSERVATIONS {
            return PoseEstimate {
                camera_from_world: *initial,
                classes: vec![InlierClass::Outlier; observations.len()],
                inliers: 0,
            };
        }
        let converged = if round + 1 == ROUNDS { CONVERGED } else { NEARLY_CONVERGED };
        let trusted = GroupedObservations::new(observations, &classes, round < ROBUST_ROUNDS);
        pose = refine(pinhole, &pose, prior, &trusted, converged);
        for (t, o) in classes.iter_mut().zip(observations) {
            *t = o.measurement.classify(pinhole, &(pose * o.point_in_world).coords);
        }
    }
    let inliers = classes.iter().filter(|t| **t != InlierClass::Outlier).count();
    PoseEstimate { camera_from_world: pose, classes, inliers }
}

/// Median of the squared pixel residuals, whitened, of all observations in front of the camera; 0 without any.
pub fn median_squared(pinhole: &Pinhole, pose: &Se3, observations: &[PoseObservation]) -> f64 {
    let residual = |o: &PoseObservation| o.measurement.residual(pinhole, &(pose * o.point_in_world).coords);
    let mut squared: Vec<f64> = observations.iter().filter_map(residual).map(|r| r.xy().norm_squared()).collect();
    let middle = squared.len() / 2;
    if squared.is_empty() { 0.0 } else { *squared.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Levenberg-Marquardt until a step is below `converged`, [`STEPS_PER_ROUND`] steps at most.
fn refine(
    pinhole: &Pinhole,
    initial: &Se3,
    prior: Option<&PosePrior>,
    observations: &GroupedObservations,
    converged: f64,
) -> Se3 {
    let linearise = |pose: &Se3| {
        let mut equations = observations.linearise(pinhole, pose);
        if let Some(prior) = prior {
            let (pull, share) = prior.pull(pose);
            equations.hessian += prior.information;
            equations.gradient += pull;
            equations.cost += share;
        }
        equations
    };
    let cost = |pose: &Se3| observations.cost(pinhole, pose) + prior.map_or(0.0, |prior| prior.pull(pose).1);
    let mut pose = *initial;
    let mut lambda = 1e-4;
    let mut equations = linearise(&pose);
    for _ in 0..STEPS_PER_ROUND {
        let NormalEquations { hessian, gradient, .. } = &equations;
        let mut damped = *hessian;
        for k in 0..6 {
            damped[(k, k)] += lambda * hessian[(k, k)] + 1e-9;
        }
        let Some(step) = damped.cholesky().map(|c| c.solve(&-gradient)) else { break };
        let candidate = se3::exp(&step) * pose;
        if step.norm() < converged {
            if cost(&candidate) < equations.cost {
                pose = candidate;
            }
            break;
        }
        let there = linearise(&candidate);
        if there.cost < equations.cost {
            (pose, equations) = (candidate, there);
            lambda *= 0.1;
        } else {
            lambda *= 10.0;
        }
    }
    pose.rotation.renormalize();
    pose
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::Vector2;

    const PIXEL_SIGMA: f64 = 0.8;
    const DEPTH_SIGMA: f64 = 0.01;

    fn gauss(random: &mut fastrand::Rng) -> f64 {
        (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
    }

    /// 300 points before the camera; every fourth pixel and every fifth depth is wrong.
    fn scene(truth: &Se3, with_depth: bool) -> Vec<PoseObservation> {
        let mut random = fastrand::Rng::with_seed(11);
        (0..300)
            .map(|i| {
                let pixel = Vector2::new(random.f64() * 640.0, random.f64() * 480.0);
                let depth = 0.7 + 3.0 * random.f64();
                let point_in_world = truth.inverse() * Point3::from(PINHOLE.unproject(&pixel, depth));
                let noise = Vector2::new(gauss(&mut random), gauss(&mut random)) * PIXEL_SIGMA;
                let error_pixel = if i % 4 == 0 { Vector2::new(random.f64() * 80.0 + 10.0, -30.0) } else { Vector2::zeros() };
                let wrong_depth = if i % 5 == 0 { 0.4 } else { 0.0 };
                let measurement = Measurement {
                    pixel: pixel + noise + error_pixel,
                    inverse_depth: with_depth.then(|| 1.0 / depth + gauss(&mut random) * DEPTH_SIGMA + wrong_depth),
                    pixel_weight: 1.0 / PIXEL_SIGMA,
                    depth_weight: 1.0 / DEPTH_SIGMA,
                };
                PoseObservation { point_in_world, measurement }
            })
            .collect()
    }

    #[test]
    fn finds_the_pose_among_outliers() {
        let truth = se3::exp(&Vector6::new(0.3, -0.2, 0.4, 0.2, -0.1, 0.3));
        let initial = se3::exp(&Vector6::new(0.08, -0.05, 0.06, 0.04, 0.03, -0.04)) * truth;
        for with_depth in [true, false] {
            let found = optimise_pose(&PINHOLE, &initial, None, &scene(&truth, with_depth));
            let error = se3::log(&(found.camera_from_world * truth.inverse()));
            assert!(error.fixed_rows::<3>(0).norm() < 2e-3 && error.fixed_rows::<3>(3).norm() < 1e-3, "{error}");
            for (i, classes) in found.classes.iter().enumerate() {
                if i % 4 == 0 {
                    assert_eq!(*classes, InlierClass::Outlier, "observation {i}");
                } else if with_depth && i % 5 == 0 {
                    assert_ne!(*classes, InlierClass::Full, "observation {i}");
                }
            }
            assert!(found.inliers > 190 && found.inliers <= 225, "{} inliers", found.inliers);
        }
    }

    #[test]
    fn a_prior_holds_what_the_observations_leave_open() {
        let truth = se3::exp(&Vector6::new(0.3, -0.2, 0.4, 0.2, -0.1, 0.3));
        // Points so far away that they tell the rotation alone.
        let mut random = fastrand::Rng::with_seed(5);
        let far: Vec<PoseObservation> = (0..60)
            .map(|_| {
                let pixel = Vector2::new(random.f64() * 640.0, random.f64() * 480.0);
                let point_in_world = truth.inverse() * Point3::from(PINHOLE.unproject(&pixel, 1e4));
                PoseObservation {
                    point_in_world,
                    measurement: Measurement { pixel, inverse_depth: None, pixel_weight: 1.0, depth_weight: 0.0 },
                }
            })
            .collect();
        let near = se3::exp(&Vector6::new(0.02, -0.01, 0.03, 0.02, 0.01, -0.02)) * truth;
        let found = |sigma: f64| {
            let prior = PosePrior { camera_from_world: near, information: Matrix6::identity() / (sigma * sigma) };
            optimise_pose(&PINHOLE, &near, Some(&prior), &far).camera_from_world
        };
        let weak = found(0.05);
        assert!(weak.rotation.angle_to(&truth.rotation) < 1e-4, "{}", weak.rotation.angle_to(&truth.rotation));
        // The camera turns where it is by the prior, up to what its covariance ties translation to rotation by.
        assert!((weak.translation.vector - near.translation.vector).norm() < 0.02);
        let strong = found(1e-7);
        assert!(se3::log(&(strong * near.inverse())).norm() < 1e-6);
    }

    #[test]
    fn with_nothing_to_go_by_the_initial_pose_comes_back() {
        let initial = se3::exp(&Vector6::new(0.3, -0.2, 0.4, 0.2, -0.1, 0.3));
        let found = optimise_pose(&PINHOLE, &initial, None, &scene(&initial, true)[..2]);
        assert_eq!((found.camera_from_world, found.inliers), (initial, 0));
    }
}
