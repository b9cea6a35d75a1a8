//! Pose-graph optimisation: poses from what is known of pairs of them, by Levenberg-Marquardt with a sparse Cholesky factorisation
//! (Grisetti et al., *A tutorial on graph-based SLAM*, 2010; over similarities after Strasdat et al., *Scale drift-aware large scale
//! monocular SLAM*, RSS 2010).
//!
//! One implementation for SE(3) and Sim(3): where the sensor knows the scale, every scale stays as it is. The first pose stays too.
//! Knows nothing of the map. Sums run in the order of the edges, and the factorisation is sequential.

use faer::prelude::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMat, Triplet};
use faer::{Col, Side};

use crate::geometry::sim3::{self, Matrix7, Sim3, Vector7};
use crate::tracking::solvers::residual::huber;

/// Damping that gives up: no step helps any more.
const MAX_LAMBDA: f64 = 1e8;
/// A step that lowers the cost by less than this share has converged.
const CONVERGED_SHARE: f64 = 1e-6;
/// Keeps the equations solvable where a pose hangs on nothing.
const MIN_DAMPING: f64 = 1e-9;

/// Relative pose factor.
#[derive(Clone, Copy, Debug)]
pub struct Edge {
    pub a: usize,
    pub b: usize,
    /// Measured relative pose.
    pub a_from_b: Sim3,
    /// 1/standard deviation of `(ρ, θ, λ)` in a: 1/metres, 1/radians, 1.
    pub weights: Vector7,
    /// Errors beyond this many standard deviations pull less and less (Huber): for edges that might be wrong.
    pub huber: Option<f64>,
}

/// Pose-graph problem over similarities.
#[derive(Clone, Debug, Default)]
pub struct PoseGraph {
    /// camera_from_world.
    pub poses: Vec<Sim3>,
    pub edges: Vec<Edge>,
    pub scale_is_free: bool,
}

/// An edge's whitened residual and its derivatives by the poses of a and b.
struct Linearised {
    residual: Vector7,
    by_a: Matrix7,
    by_b: Matrix7,
}

impl Edge {
    /// `Log(measured a_from_b · b_from_a)`, whitened; 0 where the poses agree with the edge.
    fn residual(&self, a_from_world: &Sim3, b_from_world: &Sim3) -> Vector7 {
        sim3::log(&(self.a_from_b * *b_from_world * a_from_world.inverse())).component_mul(&self.weights)
    }

    /// For left perturbations: `b` moves the argument of the logarithm from within, `a` from its right end.
    fn linearise(&self, a_from_world: &Sim3, b_from_world: &Sim3) -> Linearised {
        let error = self.a_from_b * *b_from_world * a_from_world.inverse();
        let tau = sim3::log(&error);
        let whitened = Matrix7::from_diagonal(&self.weights) * sim3::left_jacobian_inverse(&tau);
        Linearised {
            residual: tau.component_mul(&self.weights),
            by_a: -whitened * error.adjoint(),
            by_b: whitened * self.a_from_b.adjoint(),
        }
    }

    /// Cost of a squared residual, and the weight that it gives the residual.
    fn robust(&self, squared: f64) -> (f64, f64) {
        self.huber.map_or((squared, 1.0), |sigmas| huber(squared, sigmas * sigmas))
    }
}

impl PoseGraph {
    /// Moves the poses to lower the cost, `steps` steps at most. Returns the cost before and after.
    pub fn optimise(&mut self, steps: usize) -> (f64, f64) {
        let initial = self.cost();
        let (mut cost, mut lambda) = (initial, 1e-6);
        let mut symbolic = None;
        for _ in 0..steps {
            let (hessian, gradient) = self.normal_equations();
            let before = self.poses.clone();
            let mut lowered = None;
            while lambda < MAX_LAMBDA {
                if let Some(step) = solve(&hessian, &gradient, lambda, &mut symbolic) {
                    self.take(&step);
                    lowered = Some(self.cost()).filter(|candidate| *candidate < cost);
                }
                if lowered.is_some() {
                    break;
                }
                self.poses.clone_from(&before);
                lambda *= 10.0;
            }
            let Some(candidate) = lowered else { break };
            lambda = (lambda * 0.1).max(1e-12);
            let converged = cost - candidate < CONVERGED_SHARE * cost;
            cost = candidate;
            if converged {
                break;
            }
        }
        (initial, cost)
    }

    /// The robust cost of all edges.
    pub fn cost(&self) -> f64 {
        self.edges.iter().map(|e| e.robust(e.residual(&self.poses[e.a], &self.poses[e.b]).norm_squared()).0).sum()
    }

    /// Unknowns of each pose but the first.
    fn unknowns(&self) -> usize {
        if self.scale_is_free { 7 } else { 6 }
    }

    /// The lower triangle of the Gauss-Newton Hessian as `(row, column, value)`, entries of one place to be added up; the gradient.
    /// The entries' places depend on the edges alone.
    fn normal_equations(&self) -> (Vec<Triplet<usize, usize, f64>>, Vec<f64>) {
        let unknowns = self.unknowns();
        let mut hessian = Vec::with_capacity(self.edges.len() * 3 * unknowns * unknowns);
        let mut gradient = vec![0.0; unknowns * self.poses.len().saturating_sub(1)];
        for edge in &self.edges {
            let Linearised { residual, by_a, by_b } = edge.linearise(&self.poses[edge.a], &self.poses[edge.b]);
            let weight = edge.robust(residual.norm_squared()).1;
            let sides = [(edge.a, by_a), (edge.b, by_b)];
            for (row_pose, row) in sides.iter().filter(|(pose, _)| *pose > 0) {
                let slope = row.transpose() * residual * weight;
                let offset = unknowns * (row_pose - 1);
                (0..unknowns).for_each(|i| gradient[offset + i] += slope[i]);
                for (column_pose, column) in sides.iter().filter(|(pose, _)| *pose > 0 && pose <= row_pose) {
                    let block = row.transpose() * column * weight;
                    for (i, j) in (0..unknowns).flat_map(|i| (0..unknowns).map(move |j| (i, j))) {
                        hessian.push(Triplet::new(offset + i, unknowns * (column_pose - 1) + j, block[(i, j)]));
                    }
                }
            }
        }
        (hessian, gradient)
    }

    fn take(&mut self, step: &[f64]) {
        let unknowns = self.unknowns();
        for (pose, step) in self.poses.iter_mut().skip(1).zip(step.chunks(unknowns)) {
            let mut tau = Vector7::zeros();
            tau.iter_mut().zip(step).for_each(|(t, s)| *t = *s);
            *pose = sim3::exp(&tau) * *pose;
            pose.rotation.renormalize();
        }
    }
}

/// The damped step; `None` if the equations cannot be solved. The symbolic factorisation is made once and used again.
fn solve(
    hessian: &[Triplet<usize, usize, f64>],
    gradient: &[f64],
    lambda: f64,
    symbolic: &mut Option<SymbolicLlt<usize>>,
) -> Option<Vec<f64>> {
    let size = gradient.len();
    let mut entries = hessian.to_vec();
    // The diagonal twice: Marquardt's share of it, and a little of its own so that none is missing.
    entries.extend(hessian.iter().filter(|e| e.row == e.col).map(|e| Triplet::new(e.row, e.col, lambda * e.val)));
    entries.extend((0..size).map(|i| Triplet::new(i, i, MIN_DAMPING)));
    let matrix = SparseColMat::try_new_from_triplets(size, size, &entries).ok()?;
    if symbolic.is_none() {
        *symbolic = Some(SymbolicLlt::try_new(matrix.symbolic(), Side::Lower).ok()?);
    }
    let factor = Llt::try_new_with_symbolic(symbolic.clone()?, matrix.as_ref(), Side::Lower).ok()?;
    let solution = factor.solve(Col::from_fn(size, |i| -gradient[i]));
    let step: Vec<f64> = solution.iter().copied().collect();
    step.iter().all(|v| v.is_finite()).then_some(step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Se3, se3};
    use nalgebra::{Vector3, Vector6};
    use proptest::prelude::*;

    fn edge(a: usize, b: usize, a_from_b: Sim3) -> Edge {
        let weights = Vector7::from_column_slice(&[100.0, 100.0, 100.0, 300.0, 300.0, 300.0, 200.0]);
        Edge { a, b, a_from_b, weights, huber: None }
    }

    proptest! {
        #[test]
        fn jacobians_are_the_numerical_derivatives(
            poses in prop::array::uniform3(prop::array::uniform7(-0.8f64..0.8)), weights in prop::array::uniform7(0.5f64..2.0)
        ) {
            let [a, b, measured] = poses.map(|tau| sim3::exp(&Vector7::from(tau)));
            let edge = Edge { weights: Vector7::from(weights), ..edge(0, 1, measured) };
            let Linearised { residual, by_a, by_b } = edge.linearise(&a, &b);
            prop_assert!((residual - edge.residual(&a, &b)).norm() < 1e-12);
            for k in 0..7 {
                let mut step = Vector7::zeros();
                step[k] = 1e-6;
                let (up, down) = (sim3::exp(&step), sim3::exp(&-step));
                let numeric_a = (edge.residual(&(up * a), &b) - edge.residual(&(down * a), &b)) / 2e-6;
                let numeric_b = (edge.residual(&a, &(up * b)) - edge.residual(&a, &(down * b))) / 2e-6;
                prop_assert!((numeric_a - by_a.column(k)).norm() < 1e-6 * (1.0 + by_a.norm()));
                prop_assert!((numeric_b - by_b.column(k)).norm() < 1e-6 * (1.0 + by_b.norm()));
            }
        }
    }

    const STATIONS: usize = 60;

    /// camera_from_world on a circle of 4 m, looking along it.
    fn circle() -> Vec<Sim3> {
        let station = |k: usize| {
            let angle = k as f64 / STATIONS as f64 * std::f64::consts::TAU;
            let turn = Se3::new(Vector3::zeros(), Vector3::y() * angle);
            (turn * Se3::translation(0.0, 0.0, -4.0)).inverse()
        };
        (0..STATIONS).map(|k| Sim3::from(station(k) * station(0).inverse())).collect()
    }

    /// A walk round the circle whose every step is measured with the same small error, and the truth.
    fn drifted(step_error: &Sim3, scale_is_free: bool) -> (PoseGraph, Vec<Sim3>) {
        let truth = circle();
        let mut graph = PoseGraph { poses: vec![truth[0]], scale_is_free, ..Default::default() };
        for k in 1..STATIONS {
            let next_from_last = *step_error * truth[k] * truth[k - 1].inverse();
            graph.edges.push(edge(k, k - 1, next_from_last));
            graph.poses.push(next_from_last * graph.poses[k - 1]);
        }
        (graph, truth)
    }

    /// Largest distance between the centres and the true ones.
    fn off_metres(graph: &PoseGraph, truth: &[Sim3]) -> f64 {
        let centre = |pose: &Sim3| pose.inverse().translation;
        graph.poses.iter().zip(truth).map(|(p, t)| (centre(p) - centre(t)).norm()).fold(0.0, f64::max)
    }

    #[test]
    fn one_closure_pulls_a_drifted_circle_to_the_truth() {
        let rigid = Sim3::from(se3::exp(&Vector6::new(0.004, -0.002, 0.006, 0.001, 0.004, -0.001)));
        let growing = Sim3 { scale: 1.006, ..rigid };
        for (step_error, scale_is_free) in [(rigid, false), (growing, true)] {
            let (mut graph, truth) = drifted(&step_error, scale_is_free);
            let before = off_metres(&graph, &truth);
            graph.edges.push(edge(0, STATIONS - 1, truth[0] * truth[STATIONS - 1].inverse()));
            let (initial, last) = graph.optimise(50);
            let after = off_metres(&graph, &truth);
            assert!(last < 0.05 * initial && after < 0.2 * before && before > 0.3, "{initial} → {last}, {before} m → {after} m");
            assert_eq!(graph.poses[0], truth[0]);
            assert!(scale_is_free || graph.poses.iter().all(|p| p.scale == 1.0));
            let again = graph.clone();
            assert!(graph.optimise(5).1 <= last && off_metres(&graph, &truth) <= off_metres(&again, &truth) * 1.01);
        }
    }

    #[test]
    fn a_false_closure_is_doubted_and_a_loose_pose_stays() {
        let (mut graph, truth) = drifted(&Sim3::identity(), false);
        let wrong = Sim3::from(Se3::translation(2.0, 0.0, 0.0));
        graph.edges.push(Edge { huber: Some(1.0), ..edge(0, 30, wrong * truth[0] * truth[30].inverse()) });
        graph.edges.push(edge(0, STATIONS - 1, truth[0] * truth[STATIONS - 1].inverse()));
        graph.optimise(50);
        let robust_off = off_metres(&graph, &truth);
        graph.edges[STATIONS - 1].huber = None;
        graph.optimise(50);
        assert!(robust_off < 0.25 && off_metres(&graph, &truth) > 0.8, "{robust_off} m");
        let mut loose = PoseGraph { poses: truth[..3].to_vec(), ..Default::default() };
        assert_eq!(loose.optimise(3), (0.0, 0.0));
        loose.edges.push(edge(0, 1, Sim3::identity()));
        loose.optimise(5);
        assert!(sim3::log(&(loose.poses[2] * truth[2].inverse())).norm() < 1e-12);
        assert_eq!(PoseGraph::default().optimise(5), (0.0, 0.0));
    }
}
