//! Bundle adjustment: poses and points together, by Levenberg-Marquardt with the points eliminated by their Schur complement
//! (Triggs et al., *Bundle adjustment: a modern synthesis*, 2000), Huber's kernel, and depth residuals. The bias of measured depth is one more block
//! of unknowns beside the free poses.
//!
//! Knows nothing of the map; `adjustment/local_bundle.rs` makes the problem and takes the result. Sums run in the order of the observations.

use nalgebra::{Matrix3, Matrix6, Matrix6x3, Point3, Vector3, Vector6};

use crate::geometry::{Pinhole, Se3, se3};
use crate::tracking::solvers::depth_bias::{BiasPrior, DepthBias};
use crate::tracking::solvers::relative_pose::{RelativePose, RelativeTerms};
use crate::tracking::solvers::residual::{InlierClass, Measurement};
use crate::tracking::solvers::schur::ReducedSystem;

/// Damping that gives up: no step helps any more.
const MAX_LAMBDA: f64 = 1e6;
/// A step that lowers the cost by less than this share has converged.
pub const CONVERGED: f64 = 1e-4;

/// One measurement of a point by a camera.
#[derive(Clone, Copy, Debug)]
pub struct BundleObservation {
    pub pose: usize,
    pub point: usize,
    pub measurement: Measurement,
    pub class: InlierClass,
}

impl BundleObservation {
    /// Trusted as far as it was measured.
    pub fn new(pose: usize, point: usize, measurement: Measurement) -> Self {
        let class = if measurement.inverse_depth.is_some() { InlierClass::Full } else { InlierClass::PixelOnly };
        Self { pose, point, measurement, class }
    }
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
    /// Measured beside the observations.
    pub relative_poses: Vec<RelativePose>,
    /// Of all measured depths.
    pub depth_bias: DepthBias,
    /// What is known of the bias beforehand. Without a prior the bias stays as it is.
    pub bias_prior: Option<BiasPrior>,
}

/// What a block of six unknowns and a point have in common in the normal equations.
struct Mixed {
    point: usize,
    block: usize,
    block_by_point: Matrix6x3<f64>,
}

/// The normal equations, points grouped. Blocks are those of the free poses, then the bias if it is sought.
struct System {
    hessian_blocks: Vec<Matrix6<f64>>,
    gradient_blocks: Vec<Vector6<f64>>,
    /// Of the bias (rows) and each free pose (columns).
    bias_by_pose: Vec<Matrix6<f64>>,
    /// Row, column (below the row) and block of two free poses with a measured relative pose.
    pose_by_pose: Vec<(usize, usize, Matrix6<f64>)>,
    hessian_points: Vec<Matrix3<f64>>,
    gradient_points: Vec<Vector3<f64>>,
    /// Sorted by point.
    mixed: Vec<Mixed>,
}

impl BundleProblem {
    /// Moves poses and points to lower the cost, `steps` Levenberg-Marquardt steps at most, until one lowers it by less than `converged_share`. Returns
    /// the cost before and after. Observations of points that lie behind their cameras to begin with are outliers until the next classification.
    pub fn solve(&mut self, pinhole: &Pinhole, steps: usize, converged_share: f64) -> (f64, f64) {
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
            let before = (self.poses.clone(), self.points.clone(), self.depth_bias);
            let mut lowered = None;
            while lambda < MAX_LAMBDA {
                if self.step(&system, &reduced, lambda) {
                    let candidate = self.cost(pinhole);
                    if candidate < cost {
                        lowered = Some(candidate);
                        break;
                    }
                }
                (self.poses, self.points, self.depth_bias) = before.clone();
                lambda *= 10.0;
            }
            let Some(candidate) = lowered else { break };
            lambda = (lambda * 0.2).max(1e-8);
            let converged = cost - candidate < converged_share * cost;
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
            o.class = o
                .measurement
                .without_bias(pinhole, &self.depth_bias)
                .classify(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords);
        }
    }

    /// The robust cost of all trusted observations. Infinite if a point lies behind a camera that sees it, so that no step goes there.
    pub fn cost(&self, pinhole: &Pinhole) -> f64 {
        let mut sum = self.bias_prior.map_or(0.0, |prior| prior.pull(&self.depth_bias).1);
        for o in &self.observations {
            let Some(measurement) = self.measurement(o, pinhole) else { continue };
            match measurement.residual(pinhole, &(self.poses[o.pose] * self.points[o.point]).coords) {
                Some(r) => sum += Measurement::robust(&r).0,
                None => return f64::INFINITY,
            }
        }
        sum + self.relative_poses.iter().map(|relative| relative.cost(&self.poses)).sum::<f64>()
    }

    /// An observation's measurement as far as it is trusted, freed of the bias.
    fn measurement(&self, observation: &BundleObservation, pinhole: &Pinhole) -> Option<Measurement> {
        Some(observation.measurement.restricted_to(observation.class)?.without_bias(pinhole, &self.depth_bias))
    }

    fn blocks(&self) -> usize {
        self.free_poses + usize::from(self.bias_prior.is_some())
    }

    fn linearise(&self, pinhole: &Pinhole) -> System {
        let mut system = System {
            hessian_blocks: vec![Matrix6::zeros(); self.blocks()],
            gradient_blocks: vec![Vector6::zeros(); self.blocks()],
            bias_by_pose: vec![Matrix6::zeros(); self.free_poses],
            pose_by_pose: Vec::new(),
            hessian_points: vec![Matrix3::zeros(); self.points.len()],
            gradient_points: vec![Vector3::zeros(); self.points.len()],
            mixed: Vec::with_capacity(self.observations.len() + self.points.len()),
        };
        let rotations: Vec<Matrix3<f64>> = self.poses.iter().map(|p| *p.rotation.to_rotation_matrix().matrix()).collect();
        let bias = self.free_poses;
        if let Some(prior) = &self.bias_prior {
            system.hessian_blocks[bias] = Matrix6::from_diagonal(&padded(&prior.information));
            system.gradient_blocks[bias] = padded(&prior.pull(&self.depth_bias).0);
        }
        self.relative_poses.iter().for_each(|relative| self.add_relative_pose(relative, &mut system));
        for group in self.observations.chunk_by(|a, b| a.point == b.point) {
            let point = group[0].point;
            let mut bias_by_point = Matrix6x3::zeros();
            for o in group {
                let Some(measurement) = self.measurement(o, pinhole) else { continue };
                let pose = &self.poses[o.pose];
                let p_in_camera = (pose * self.points[point]).coords;
                let Some(residual) = measurement.residual(pinhole, &p_in_camera) else { continue };
                let weights = Matrix3::from_diagonal(&Measurement::robust(&residual).1);
                let by_camera_point = measurement.jacobian(pinhole, &p_in_camera);
                let by_point = by_camera_point * rotations[o.pose];
                let weighted = by_point.transpose() * weights;
                system.hessian_points[point] += weighted * by_point;
                system.gradient_points[point] += weighted * residual;
                let by_pose = (o.pose < bias).then(|| measurement.jacobian_by_pose(pinhole, &p_in_camera));
                if let Some(by_pose) = &by_pose {
                    let pose_by = by_pose.transpose();
                    let weighted = pose_by * weights;
                    add_product(&mut system.hessian_blocks[o.pose], &weighted, &pose_by);
                    system.gradient_blocks[o.pose] += weighted * residual;
                    system.mixed.push(Mixed { point, block: o.pose, block_by_point: weighted * by_point });
                }
                if self.bias_prior.is_some() && measurement.inverse_depth.is_some() {
                    // Of the residual's third entry alone.
                    let by_bias = padded(&DepthBias::terms(pinhole, &measurement.pixel)) * measurement.depth_weight;
                    let weighted = by_bias * weights[(2, 2)];
                    system.hessian_blocks[bias] += weighted * by_bias.transpose();
                    system.gradient_blocks[bias] += weighted * residual.z;
                    bias_by_point += weighted * by_point.row(2);
                    if let Some(by_pose) = &by_pose {
                        system.bias_by_pose[o.pose] += weighted * by_pose.row(2);
                    }
                }
            }
            if self.bias_prior.is_some() {
                system.mixed.push(Mixed { point, block: bias, block_by_point: bias_by_point });
            }
        }
        system
    }

    fn add_relative_pose(&self, relative: &RelativePose, system: &mut System) {
        let RelativeTerms { current, reference, mixed } = relative.linearise(&self.poses);
        for (pose, (hessian, gradient)) in [(relative.current, current), (relative.reference, reference)] {
            if pose < self.free_poses {
                system.hessian_blocks[pose] += hessian;
                system.gradient_blocks[pose] += gradient;
            }
        }
        let (row, column) = (relative.current.max(relative.reference), relative.current.min(relative.reference));
        if row < self.free_poses {
            system.pose_by_pose.push((row, column, if row == relative.current { mixed } else { mixed.transpose() }));
        }
    }

    /// Sparsity of the reduced system; `None` if it has too many blocks.
    fn reduced_system(&self) -> Option<ReducedSystem> {
        let bias = self.free_poses;
        let is_free = |pose: &usize| *pose < bias;
        let seen = self.observations.chunk_by(|a, b| a.point == b.point).flat_map(|group| {
            let poses: Vec<usize> = group.iter().map(|o| o.pose).filter(is_free).collect();
            let pairs: Vec<(usize, usize)> = poses.iter().flat_map(|a| poses.iter().map(|b| (*a, *b))).collect();
            pairs
        });
        let with_bias = (0..if self.bias_prior.is_some() { bias } else { 0 }).map(|pose| (bias, pose));
        let relative = self.relative_poses.iter().map(|r| (r.current, r.reference)).filter(|(a, b)| is_free(a) && is_free(b));
        ReducedSystem::new(self.blocks(), seen.chain(with_bias).chain(relative))
    }

    /// Takes one damped step; `false` if the equations cannot be solved.
    fn step(&mut self, system: &System, reduced: &ReducedSystem, lambda: f64) -> bool {
        let point_inverses: Vec<Option<Matrix3<f64>>> = system
            .hessian_points
            .iter()
            .map(|h| damped3(h, lambda).try_inverse().filter(|m| m.iter().all(|v| v.is_finite())))
            .collect();
        let Some(steps) = solve_blocks(system, reduced, &point_inverses, lambda) else { return false };
        let mut right: Vec<Vector3<f64>> = system.gradient_points.iter().map(|g| -g).collect();
        for m in &system.mixed {
            right[m.point] -= m.block_by_point.transpose() * steps[m.block];
        }
        for (pose, step) in self.poses[..self.free_poses].iter_mut().zip(&steps) {
            *pose = se3::exp(step) * *pose;
            pose.rotation.renormalize();
        }
        if self.bias_prior.is_some() {
            self.depth_bias.0 += steps[self.free_poses].fixed_rows::<3>(0);
        }
        for ((point, inverse), r) in self.points.iter_mut().zip(&point_inverses).zip(&right) {
            if let Some(inverse) = inverse {
                *point += inverse * r;
            }
        }
        true
    }
}

/// The blocks' steps from the reduced system.
fn solve_blocks(
    system: &System,
    reduced: &ReducedSystem,
    point_inverses: &[Option<Matrix3<f64>>],
    lambda: f64,
) -> Option<Vec<Vector6<f64>>> {
    let mut blocks = reduced.zeros();
    let mut right: Vec<Vector6<f64>> = system.gradient_blocks.iter().map(|g| -g).collect();
    for (k, h) in system.hessian_blocks.iter().enumerate() {
        let damped = &mut blocks[reduced.place(k, k)];
        *damped = *h;
        (0..6).for_each(|i| damped[(i, i)] += lambda * h[(i, i)] + 1e-9);
    }
    let bias = system.bias_by_pose.len();
    if bias < system.hessian_blocks.len() {
        for (pose, coupling) in system.bias_by_pose.iter().enumerate() {
            blocks[reduced.place(bias, pose)] = *coupling;
        }
    }
    for (row, column, block) in &system.pose_by_pose {
        blocks[reduced.place(*row, *column)] += block;
    }
    for group in system.mixed.chunk_by(|a, b| a.point == b.point) {
        let point = group[0].point;
        let Some(inverse) = &point_inverses[point] else { continue };
        for a in group {
            let gain = a.block_by_point * inverse;
            let less = -gain;
            right[a.block] += gain * system.gradient_points[point];
            // The lower triangle is all that Cholesky reads.
            for b in group.iter().filter(|b| b.block <= a.block) {
                add_product(&mut blocks[reduced.place(a.block, b.block)], &less, &b.block_by_point);
            }
        }
    }
    let right: Vec<f64> = right.iter().flat_map(|r| r.iter().copied()).collect();
    let steps = reduced.solve(&blocks, &right)?;
    Some(steps.chunks_exact(6).map(Vector6::from_column_slice).collect())
}

/// The bias' three unknowns as a block of six; the others stay zero.
fn padded(bias: &Vector3<f64>) -> Vector6<f64> {
    bias.fixed_resize::<6, 1>(0.0)
}

/// Adds `a·bᵀ` to a block. Written out, for it is most of the work.
fn add_product(block: &mut Matrix6<f64>, a: &Matrix6x3<f64>, b: &Matrix6x3<f64>) {
    for j in 0..6 {
        for i in 0..6 {
            block[(i, j)] += a[(i, 0)] * b[(j, 0)] + a[(i, 1)] * b[(j, 1)] + a[(i, 2)] * b[(j, 2)];
        }
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
