//! Bundle adjustment: poses and points together, by Levenberg-Marquardt with the points eliminated by their Schur complement
//! (Triggs et al., *Bundle adjustment: a modern synthesis*, 2000), Huber's kernel and depth residuals.
//!
//! Knows nothing of the map; `window.rs` makes the problem and takes the result. Sums run in the order of the observations.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Matrix6x3, Point3, Vector3, Vector6};

use super::measurement::{Measurement, Trust, point_by_pose};
use crate::geometry::{Pinhole, Se3, se3};

/// Damping that gives up: no step helps any more.
const MAX_LAMBDA: f64 = 1e6;
/// A step that lowers the cost by less than this share has converged.
const CONVERGED_SHARE: f64 = 1e-4;

/// One measurement of a point by a camera.
#[derive(Clone, Copy, Debug)]
pub struct BundleObservation {
    pub pose: usize,
    pub point: usize,
    pub measurement: Measurement,
    pub trust: Trust,
}

/// What is to be solved.
#[derive(Clone, Debug, Default)]
pub struct BundleProblem {
    /// camera_from_world.
    pub poses: Vec<Se3>,
    /// The first `free_poses` poses move, the others stay.
    pub free_poses: usize,
    /// In the world, metres.
    pub points: Vec<Point3<f64>>,
    /// Sorted by point.
    pub observations: Vec<BundleObservation>,
}

/// An observation's share of the normal equations.
struct Linearised {
    observation: usize,
    pose: usize,
    pose_by_point: Matrix6x3<f64>,
}

/// The normal equations, points grouped.
struct System {
    hessian_poses: Vec<Matrix6<f64>>,
    gradient_poses: Vec<Vector6<f64>>,
    hessian_points: Vec<Matrix3<f64>>,
    gradient_points: Vec<Vector3<f64>>,
    /// Of free poses only, sorted by point.
    mixed: Vec<Linearised>,
}

impl BundleProblem {
    /// Moves poses and points to lower the cost, `steps` Levenberg-Marquardt steps at most. Returns the cost before and after.
    pub fn solve(&mut self, pinhole: &Pinhole, steps: usize) -> (f64, f64) {
        let initial = self.cost(pinhole);
        let (mut cost, mut lambda) = (initial, 1e-4);
        for _ in 0..steps {
            let system = self.linearise(pinhole);
            let before = (self.poses.clone(), self.points.clone());
            let mut lowered = None;
            while lambda < MAX_LAMBDA {
                if self.step(&system, lambda) {
                    let candidate = self.cost(pinhole);
                    if candidate < cost {
                        lowered = Some(candidate);
                        break;
                    }
                }
                (self.poses, self.points) = before.clone();
                lambda *= 10.0;
            }
            let Some(candidate) = lowered else { break };
            lambda = (lambda * 0.2).max(1e-8);
            let converged = cost - candidate < CONVERGED_SHARE * cost;
            cost = candidate;
            if converged {
                break;
            }
        }
        (initial, cost)
    }

    /// Judges every observation anew by χ².
    pub fn judge(&mut self, pinhole: &Pinhole) {
        for o in &mut self.observations {
            o.trust = o.measurement.judge(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords);
        }
    }

    /// The robust cost of all trusted observations. Infinite if a point lies behind a camera that sees it, so that no step goes there.
    pub fn cost(&self, pinhole: &Pinhole) -> f64 {
        let mut sum = 0.0;
        for o in &self.observations {
            let Some(measurement) = o.measurement.trusted(o.trust) else { continue };
            match measurement.residual(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords) {
                Some(r) => sum += Measurement::robust(&r).0,
                None => return f64::INFINITY,
            }
        }
        sum
    }

    fn linearise(&self, pinhole: &Pinhole) -> System {
        let mut system = System {
            hessian_poses: vec![Matrix6::zeros(); self.free_poses],
            gradient_poses: vec![Vector6::zeros(); self.free_poses],
            hessian_points: vec![Matrix3::zeros(); self.points.len()],
            gradient_points: vec![Vector3::zeros(); self.points.len()],
            mixed: Vec::with_capacity(self.observations.len()),
        };
        for (index, o) in self.observations.iter().enumerate() {
            let Some(measurement) = o.measurement.trusted(o.trust) else { continue };
            let pose = &self.poses[o.pose];
            let p_in_camera = (pose * self.points[o.point]).coords;
            let Some(residual) = measurement.residual(pinhole, &p_in_camera) else { continue };
            let weights = Matrix3::from_diagonal(&Measurement::robust(&residual).1);
            let by_camera_point = measurement.jacobian(pinhole, &p_in_camera);
            let by_point = by_camera_point * pose.rotation.to_rotation_matrix().matrix();
            let weighted = by_point.transpose() * weights;
            system.hessian_points[o.point] += weighted * by_point;
            system.gradient_points[o.point] += weighted * residual;
            if o.pose < self.free_poses {
                let by_pose = by_camera_point * point_by_pose(&p_in_camera);
                let weighted = by_pose.transpose() * weights;
                system.hessian_poses[o.pose] += weighted * by_pose;
                system.gradient_poses[o.pose] += weighted * residual;
                system.mixed.push(Linearised { observation: index, pose: o.pose, pose_by_point: weighted * by_point });
            }
        }
        system
    }

    /// Takes one damped step; `false` if the equations cannot be solved.
    fn step(&mut self, system: &System, lambda: f64) -> bool {
        let point_inverses: Vec<Option<Matrix3<f64>>> = system
            .hessian_points
            .iter()
            .map(|h| damped3(h, lambda).try_inverse().filter(|m| m.iter().all(|v| v.is_finite())))
            .collect();
        let Some(pose_steps) = self.solve_poses(system, &point_inverses, lambda) else { return false };
        let mut right: Vec<Vector3<f64>> = system.gradient_points.iter().map(|g| -g).collect();
        for m in &system.mixed {
            let step: Vector6<f64> = pose_steps.fixed_rows::<6>(6 * m.pose).into_owned();
            right[self.observations[m.observation].point] -= m.pose_by_point.transpose() * step;
        }
        for (pose, k) in self.poses[..self.free_poses].iter_mut().zip(0..) {
            *pose = se3::exp(&pose_steps.fixed_rows::<6>(6 * k).into_owned()) * *pose;
            pose.rotation.renormalize();
        }
        for ((point, inverse), r) in self.points.iter_mut().zip(&point_inverses).zip(&right) {
            if let Some(inverse) = inverse {
                *point += inverse * r;
            }
        }
        true
    }

    /// The poses' steps from the reduced camera system, `[6 * free_poses]`.
    fn solve_poses(&self, system: &System, point_inverses: &[Option<Matrix3<f64>>], lambda: f64) -> Option<DVector<f64>> {
        let size = 6 * self.free_poses;
        let mut reduced = DMatrix::<f64>::zeros(size, size);
        let mut right = DVector::<f64>::zeros(size);
        for (k, (h, g)) in system.hessian_poses.iter().zip(&system.gradient_poses).enumerate() {
            let mut damped = *h;
            (0..6).for_each(|i| damped[(i, i)] += lambda * h[(i, i)] + 1e-9);
            reduced.fixed_view_mut::<6, 6>(6 * k, 6 * k).copy_from(&damped);
            right.fixed_rows_mut::<6>(6 * k).copy_from(&-g);
        }
        let point_of = |m: &Linearised| self.observations[m.observation].point;
        for group in system.mixed.chunk_by(|a, b| point_of(a) == point_of(b)) {
            let point = point_of(&group[0]);
            let Some(inverse) = &point_inverses[point] else { continue };
            for a in group {
                let gain = a.pose_by_point * inverse;
                let mut target = right.fixed_rows_mut::<6>(6 * a.pose);
                target += gain * system.gradient_points[point];
                // The lower triangle is all that Cholesky reads.
                for b in group.iter().filter(|b| b.pose <= a.pose) {
                    let mut block = reduced.fixed_view_mut::<6, 6>(6 * a.pose, 6 * b.pose);
                    block -= gain * b.pose_by_point.transpose();
                }
            }
        }
        let solution = reduced.cholesky()?.solve(&right);
        solution.iter().all(|v| v.is_finite()).then_some(solution)
    }
}

fn damped3(hessian: &Matrix3<f64>, lambda: f64) -> Matrix3<f64> {
    let mut damped = *hessian;
    (0..3).for_each(|k| damped[(k, k)] += lambda * hessian[(k, k)] + 1e-9);
    damped
}

#[cfg(test)]
mod tests {
    use super::super::measurement::tests::PINHOLE;
    use super::*;
    use nalgebra::Vector2;

    fn noise(random: &mut fastrand::Rng) -> f64 {
        (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
    }

    /// Six cameras before 200 points, the last two fixed; everything free starts off the truth. Returns the problem and the truth.
    fn scene(pixel_noise: f64, outliers: bool) -> (BundleProblem, BundleProblem) {
        let mut random = fastrand::Rng::with_seed(21);
        let mut truth = BundleProblem { free_poses: 4, ..Default::default() };
        for k in 0..6 {
            let t = f64::from(k);
            truth.poses.push(se3::exp(&Vector6::new(0.1 * t, -0.05 * t, 0.03 * t, 0.02 * t, 0.03 * t, -0.01 * t)));
        }
        for point in 0..200 {
            let pixel = Vector2::new(100.0 + 440.0 * random.f64(), 80.0 + 320.0 * random.f64());
            truth.points.push(Point3::from(PINHOLE.unproject(&pixel, 1.0 + 2.0 * random.f64())));
            for pose in 0..6 {
                let p = (truth.poses[pose] * truth.points[point]).coords;
                let mut pixel = PINHOLE.project(&p).unwrap();
                pixel += Vector2::new(noise(&mut random), noise(&mut random)) * pixel_noise;
                if outliers && (point + pose) % 15 == 0 {
                    pixel.x += 25.0;
                }
                let inverse_depth = (point % 3 > 0).then(|| 1.0 / p.z + 0.01 * pixel_noise * noise(&mut random));
                let measurement = Measurement { pixel, inverse_depth, pixel_weight: 1.0, depth_weight: 100.0 };
                let trust = if inverse_depth.is_some() { Trust::Full } else { Trust::PixelOnly };
                truth.observations.push(BundleObservation { pose, point, measurement, trust });
            }
        }
        let mut problem = truth.clone();
        for pose in &mut problem.poses[..4] {
            *pose = se3::exp(&Vector6::from_fn(|_, _| 0.01 * noise(&mut random))) * *pose;
        }
        problem.points.iter_mut().for_each(|p| *p += Vector3::from_fn(|_, _| 0.03 * noise(&mut random)));
        (problem, truth)
    }

    fn worst_pose_error(problem: &BundleProblem, truth: &BundleProblem) -> f64 {
        let errors = problem.poses.iter().zip(&truth.poses).map(|(a, b)| se3::log(&(a * b.inverse())).norm());
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn perfect_measurements_give_the_truth() {
        let (mut problem, truth) = scene(0.0, false);
        let (before, after) = problem.solve(&PINHOLE, 30);
        assert!(before > 1e4 && after < 1e-6, "{before} → {after}");
        assert!(worst_pose_error(&problem, &truth) < 1e-5);
        let points = problem.points.iter().zip(&truth.points).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        assert!(points < 1e-4, "{points}");
    }

    #[test]
    fn outliers_are_found_and_do_not_pull() {
        let (mut problem, truth) = scene(0.5, true);
        let start = worst_pose_error(&problem, &truth);
        problem.solve(&PINHOLE, 10);
        problem.judge(&PINHOLE);
        problem.solve(&PINHOLE, 10);
        let end = worst_pose_error(&problem, &truth);
        assert!(start > 0.02 && end < 0.003, "{start} → {end}");
        for o in &problem.observations {
            if (o.point + o.pose) % 15 == 0 {
                assert_eq!(o.trust, Trust::Outlier);
            }
        }
    }

    #[test]
    fn the_reduced_system_steps_as_the_full_one_does() {
        let (problem, _) = scene(0.5, false);
        let problem =
            BundleProblem { points: problem.points[..8].to_vec(), observations: problem.observations[..48].to_vec(), ..problem };
        let system = problem.linearise(&PINHOLE);
        let (lambda, poses, size) = (1e-3, 24, 24 + 24);
        let (mut full, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        for k in 0..4 {
            full.fixed_view_mut::<6, 6>(6 * k, 6 * k).copy_from(&system.hessian_poses[k]);
            right.fixed_rows_mut::<6>(6 * k).copy_from(&-system.gradient_poses[k]);
        }
        for k in 0..8 {
            full.fixed_view_mut::<3, 3>(poses + 3 * k, poses + 3 * k).copy_from(&system.hessian_points[k]);
            right.fixed_rows_mut::<3>(poses + 3 * k).copy_from(&-system.gradient_points[k]);
        }
        for m in &system.mixed {
            let point = problem.observations[m.observation].point;
            full.fixed_view_mut::<6, 3>(6 * m.pose, poses + 3 * point).copy_from(&m.pose_by_point);
            full.fixed_view_mut::<3, 6>(poses + 3 * point, 6 * m.pose).copy_from(&m.pose_by_point.transpose());
        }
        (0..size).for_each(|k| full[(k, k)] += lambda * full[(k, k)] + 1e-9);
        let expected = full.lu().solve(&right).unwrap();
        let mut stepped = problem.clone();
        assert!(stepped.step(&system, lambda));
        for k in 0..4 {
            let step = se3::log(&(stepped.poses[k] * problem.poses[k].inverse()));
            assert!((step - expected.rows(6 * k, 6)).norm() < 1e-8);
        }
        for k in 0..8 {
            assert!((stepped.points[k] - problem.points[k] - expected.rows(poses + 3 * k, 3)).norm() < 1e-8);
        }
    }
}
