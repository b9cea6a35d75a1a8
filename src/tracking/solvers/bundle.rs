//! Bundle adjustment: poses and points together, by Levenberg-Marquardt with the points eliminated by their Schur complement
//! (Triggs et al., *Bundle adjustment: a modern synthesis*, 2000), Huber's kernel, and depth residuals.
//!
//! Knows nothing of the map; `window.rs` makes the problem and takes the result. Sums run in the order of the observations.

use nalgebra::{Matrix3, Matrix6, Matrix6x3, Point3, Vector3, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::tracking::solvers::residual::{InlierClass, Measurement, point_by_pose};
use crate::tracking::solvers::schur::ReducedSystem;

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
    pub class: InlierClass,
}

/// Bundle adjustment problem.
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
struct Mixed {
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
    /// Blocks of free poses, sorted by point.
    mixed: Vec<Mixed>,
}

impl BundleProblem {
    /// Moves poses and points to lower the cost, `steps` Levenberg-Marquardt steps at most. Returns the cost before and after.
    /// Observations of points that lie behind their cameras to begin with are outliers until the next classification.
    pub fn solve(&mut self, pinhole: &Pinhole, steps: usize) -> (f64, f64) {
        for o in &mut self.observations {
            if o.measurement.residual(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords).is_none() {
                o.class = InlierClass::Outlier;
            }
        }
        let initial = self.cost(pinhole);
        let (mut cost, mut lambda) = (initial, 1e-4);
        let Some(reduced) = self.reduced_system() else { return (initial, initial) };
        for _ in 0..steps {
            let system = self.linearise(pinhole);
            let before = (self.poses.clone(), self.points.clone());
            let mut lowered = None;
            while lambda < MAX_LAMBDA {
                if self.step(&system, &reduced, lambda) {
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
    pub fn classify(&mut self, pinhole: &Pinhole) {
        for o in &mut self.observations {
            o.class = o.measurement.classify(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords);
        }
    }

    /// The robust cost of all trusted observations. Infinite if a point lies behind a camera that sees it, so that no step goes there.
    pub fn cost(&self, pinhole: &Pinhole) -> f64 {
        let mut sum = 0.0;
        for o in &self.observations {
            let Some(measurement) = o.measurement.restricted_to(o.class) else { continue };
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
            let Some(measurement) = o.measurement.restricted_to(o.class) else { continue };
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
                system.mixed.push(Mixed { observation: index, pose: o.pose, pose_by_point: weighted * by_point });
            }
        }
        system
    }

    /// Sparsity of the reduced camera system; `None` if it has too many blocks.
    fn reduced_system(&self) -> Option<ReducedSystem> {
        let is_free = |pose: &usize| *pose < self.free_poses;
        let seen = self.observations.chunk_by(|a, b| a.point == b.point).flat_map(|group| {
            let poses: Vec<usize> = group.iter().map(|o| o.pose).filter(is_free).collect();
            let pairs: Vec<(usize, usize)> = poses.iter().flat_map(|a| poses.iter().map(|b| (*a, *b))).collect();
            pairs
        });
        ReducedSystem::new(self.free_poses, seen)
    }

    /// Takes one damped step; `false` if the equations cannot be solved.
    fn step(&mut self, system: &System, reduced: &ReducedSystem, lambda: f64) -> bool {
        let point_inverses: Vec<Option<Matrix3<f64>>> = system
            .hessian_points
            .iter()
            .map(|h| damped3(h, lambda).try_inverse().filter(|m| m.iter().all(|v| v.is_finite())))
            .collect();
        let Some(pose_steps) = self.solve_poses(system, reduced, &point_inverses, lambda) else { return false };
        let mut right: Vec<Vector3<f64>> = system.gradient_points.iter().map(|g| -g).collect();
        for m in &system.mixed {
            let step = Vector6::from_column_slice(&pose_steps[6 * m.pose..][..6]);
            right[self.observations[m.observation].point] -= m.pose_by_point.transpose() * step;
        }
        for (pose, step) in self.poses.iter_mut().zip(pose_steps.chunks_exact(6)) {
            *pose = se3::exp(&Vector6::from_column_slice(step)) * *pose;
            pose.rotation.renormalize();
        }
        for ((point, inverse), r) in self.points.iter_mut().zip(&point_inverses).zip(&right) {
            if let Some(inverse) = inverse {
                *point += inverse * r;
            }
        }
        true
    }

    /// The poses' steps from the reduced camera system, 6 entries for each free pose.
    fn solve_poses(
        &self,
        system: &System,
        reduced: &ReducedSystem,
        point_inverses: &[Option<Matrix3<f64>>],
        lambda: f64,
    ) -> Option<Vec<f64>> {
        let mut blocks = reduced.zeros();
        let mut right: Vec<Vector6<f64>> = system.gradient_poses.iter().map(|g| -g).collect();
        for (k, h) in system.hessian_poses.iter().enumerate() {
            let damped = &mut blocks[reduced.place(k, k)];
            *damped = *h;
            (0..6).for_each(|i| damped[(i, i)] += lambda * h[(i, i)] + 1e-9);
        }
        let point_of = |m: &Mixed| self.observations[m.observation].point;
        for group in system.mixed.chunk_by(|a, b| point_of(a) == point_of(b)) {
            let point = point_of(&group[0]);
            let Some(inverse) = &point_inverses[point] else { continue };
            for a in group {
                let gain = a.pose_by_point * inverse;
                right[a.pose] += gain * system.gradient_points[point];
                // The lower triangle is all that Cholesky reads.
                for b in group.iter().filter(|b| b.pose <= a.pose) {
                    blocks[reduced.place(a.pose, b.pose)] -= gain * b.pose_by_point.transpose();
                }
            }
        }
        let right: Vec<f64> = right.iter().flat_map(|r| r.iter().copied()).collect();
        reduced.solve(&blocks, &right)
    }
}

fn damped3(hessian: &Matrix3<f64>, lambda: f64) -> Matrix3<f64> {
    let mut damped = *hessian;
    (0..3).for_each(|k| damped[(k, k)] += lambda * hessian[(k, k)] + 1e-9);
    damped
}

#[cfg(test)]
#[path = "bundle_tests.rs"]
mod tests;
