//! Bundle adjustment that also estimates the focal length and the first radial distortion term of the one camera: Levenberg-Marquardt on pixels as
//! they were recorded, with the points eliminated (Triggs et al., *Bundle adjustment: a modern synthesis*, 2000; Brown, *Close-range camera
//! calibration*, 1971).
//!
//! For some tens of poses: the reduced system is dense. The first pose stays; the scale is free, and damping alone holds it.

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix2x6, Matrix3, Point3, SMatrix, Vector2, Vector3, Vector6};

use crate::geometry::{Se3, se3};
use crate::tracking::solvers::residual::point_by_pose;

/// 95% of true pixels lie below this squared error, standard deviations (χ², 2 degrees of freedom).
const CHI2_PIXEL: f64 = 5.991;
const MAX_LAMBDA: f64 = 1e8;
const CONVERGED_SHARE: f64 = 1e-7;

/// What is estimated of the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Pixels, along both axes.
    pub focal: f64,
    /// First radial distortion term, on normalised coordinates.
    pub k1: f64,
}

impl Lens {
    /// The recorded pixel, relative to the principal point, of a point in the camera frame.
    fn project(&self, p: &Vector3<f64>) -> Vector2<f64> {
        let n = p.xy() / p.z;
        n * (self.focal * (1.0 + self.k1 * n.norm_squared()))
    }
}

/// A recorded pixel, relative to the principal point.
#[derive(Clone, Copy, Debug)]
pub struct PixelObservation {
    pub pose: usize,
    pub point: usize,
    pub pixel: Vector2<f64>,
    /// 1/standard deviation of each coordinate, 1/pixels.
    pub weight: f64,
}

/// Poses, points and lens to be estimated together.
#[derive(Clone, Debug)]
pub struct LensProblem {
    pub lens: Lens,
    /// camera_from_world.
    pub poses: Vec<Se3>,
    pub points: Vec<Point3<f64>>,
    /// Sorted by point.
    pub observations: Vec<PixelObservation>,
}

/// How sure a lens is.
#[derive(Clone, Copy, Debug)]
pub struct LensDeviation {
    /// Standard deviation of the focal length as a share of it.
    pub focal: f64,
    /// Standard deviation of the distortion term.
    pub k1: f64,
}

struct Linearised {
    residual: Vector2<f64>,
    by_pose: Matrix2x6<f64>,
    by_point: Matrix2x3<f64>,
    /// By the logarithm of the focal length, and by k1.
    by_lens: Matrix2<f64>,
}

/// The reduced system of poses and lens, and what gives the points' steps.
struct Reduced {
    hessian: DMatrix<f64>,
    gradient: DVector<f64>,
    points: Vec<(Matrix3<f64>, Vector3<f64>)>,
}

impl LensProblem {
    fn residual(&self, o: &PixelObservation) -> Option<Vector2<f64>> {
        let p = (self.poses[o.pose] * self.points[o.point]).coords;
        (p.z > 1e-3).then(|| (self.lens.project(&p) - o.pixel) * o.weight)
    }

    fn linearise(&self, o: &PixelObservation) -> Option<Linearised> {
        let pose = &self.poses[o.pose];
        let p = (pose * self.points[o.point]).coords;
        let residual = self.residual(o)?;
        let n = p.xy() / p.z;
        let (r2, scale) = (n.norm_squared(), self.lens.focal * o.weight);
        let by_normalised = Matrix2::identity() * (1.0 + self.lens.k1 * r2) + n * n.transpose() * (2.0 * self.lens.k1);
        let by_camera_point = by_normalised * Matrix2x3::new(1.0, 0.0, -n.x, 0.0, 1.0, -n.y) * (scale / p.z);
        Some(Linearised {
            residual,
            by_pose: by_camera_point * point_by_pose(&p),
            by_point: by_camera_point * pose.rotation.to_rotation_matrix().matrix(),
            by_lens: Matrix2::from_columns(&[n * ((1.0 + self.lens.k1 * r2) * scale), n * (r2 * scale)]),
        })
    }

    /// Robust cost; infinite if a point lies behind a camera that sees it.
    fn cost(&self) -> f64 {
        let of = |o: &PixelObservation| self.residual(o).map_or(f64::INFINITY, |r| huber(r.norm_squared()).0);
        self.observations.iter().map(of).sum()
    }

    /// Root mean square of the whitened residuals below the outlier bound, and the observations below it.
    pub fn agreement(&self) -> (f64, usize) {
        let squared = self.observations.iter().filter_map(|o| Some(self.residual(o)?.norm_squared()));
        let inliers: Vec<f64> = squared.filter(|s| *s < CHI2_PIXEL).collect();
        ((inliers.iter().sum::<f64>() / (2.0 * inliers.len().max(1) as f64)).sqrt(), inliers.len())
    }

    /// Leaves out observations of points that lie behind their cameras.
    pub fn drop_hidden(&mut self) {
        let seen: Vec<PixelObservation> = self.observations.iter().filter(|o| self.residual(o).is_some()).copied().collect();
        self.observations = seen;
    }

    /// Leaves out observations that disagree, and points that fewer than two others see then.
    pub fn drop_outliers(&mut self) {
        let agrees: Vec<bool> =
            self.observations.iter().map(|o| self.residual(o).is_some_and(|r| r.norm_squared() < CHI2_PIXEL)).collect();
        let mut agrees = agrees.iter();
        self.observations.retain(|_| *agrees.next().expect("one for each"));
        let mut seen = vec![0; self.points.len()];
        self.observations.iter().for_each(|o| seen[o.point] += 1);
        self.observations.retain(|o| seen[o.point] > 2);
    }

    /// Takes `steps` Levenberg-Marquardt steps at most; returns how sure the lens is, `None` if the system says nothing of it.
    pub fn solve(&mut self, steps: usize) -> Option<LensDeviation> {
        let (mut cost, mut lambda) = (self.cost(), 1e-3);
        for _ in 0..steps {
            let before = self.clone();
            let mut lowered = None;
            while lambda < MAX_LAMBDA {
                if before.step(lambda).is_some_and(|stepped| {
                    *self = stepped;
                    self.cost() < cost
                }) {
                    lowered = Some(self.cost());
                    break;
                }
                lambda *= 10.0;
            }
            let Some(candidate) = lowered else {
                *self = before;
                break;
            };
            lambda = (lambda * 0.1).max(1e-10);
            let converged = cost - candidate < CONVERGED_SHARE * cost;
            cost = candidate;
            if converged {
                break;
            }
        }
        self.deviation()
    }

    /// Normal equations with the points eliminated; `lambda` damps both.
    fn reduce(&self, lambda: f64) -> Reduced {
        let unknowns = 6 * (self.poses.len() - 1) + 2;
        let lens_at = unknowns - 2;
        let mut hessian = DMatrix::zeros(unknowns, unknowns);
        let mut gradient = DVector::zeros(unknowns);
        let mut points = vec![(Matrix3::zeros(), Vector3::zeros()); self.points.len()];
        for group in self.observations.chunk_by(|a, b| a.point == b.point) {
            let (mut by_points, mut right) = (Matrix3::<f64>::zeros(), Vector3::<f64>::zeros());
            let mut mixed: Vec<(usize, SMatrix<f64, 6, 3>)> = Vec::new();
            let mut lens_mixed = SMatrix::<f64, 2, 3>::zeros();
            for o in group {
                let Some(l) = self.linearise(o) else { continue };
                let weight = huber(l.residual.norm_squared()).1;
                by_points += l.by_point.transpose() * l.by_point * weight;
                right += l.by_point.transpose() * l.residual * weight;
                let lens = l.by_lens.transpose() * weight;
                lens_mixed += lens * l.by_point;
                add(&mut hessian, lens_at, lens_at, &(lens * l.by_lens));
                add(&mut gradient, lens_at, 0, &(lens * l.residual));
                if let Some(pose) = o.pose.checked_sub(1) {
                    let weighted = l.by_pose.transpose() * weight;
                    add(&mut hessian, 6 * pose, 6 * pose, &(weighted * l.by_pose));
                    add(&mut hessian, lens_at, 6 * pose, &(lens * l.by_pose));
                    add(&mut gradient, 6 * pose, 0, &(weighted * l.residual));
                    mixed.push((6 * pose, weighted * l.by_point));
                }
            }
            (0..3).for_each(|i| by_points[(i, i)] += lambda * by_points[(i, i)] + 1e-9);
            let Some(inverse) = by_points.try_inverse() else { continue };
            points[group[0].point] = (inverse, right);
            for (at, block) in &mixed {
                let gain = block * inverse;
                add(&mut gradient, *at, 0, &(-gain * right));
                // The lower triangle, which is all that Cholesky reads.
                for (other, theirs) in mixed.iter().filter(|(other, _)| other <= at) {
                    add(&mut hessian, *at, *other, &(-gain * theirs.transpose()));
                }
            }
            let gain = lens_mixed * inverse;
            add(&mut gradient, lens_at, 0, &(-gain * right));
            add(&mut hessian, lens_at, lens_at, &(-gain * lens_mixed.transpose()));
            mixed.iter().for_each(|(at, block)| add(&mut hessian, lens_at, *at, &(-gain * block.transpose())));
        }
        (0..unknowns).for_each(|i| hessian[(i, i)] += lambda * hessian[(i, i)].abs() + 1e-9);
        Reduced { hessian, gradient, points }
    }

    /// The problem after one damped step; `None` if the equations cannot be solved.
    fn step(&self, lambda: f64) -> Option<Self> {
        let Reduced { hessian, gradient, points } = self.reduce(lambda);
        let step = hessian.cholesky()?.solve(&-gradient);
        if step.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let lens_step = Vector2::new(step[step.len() - 2], step[step.len() - 1]);
        let mut next = self.clone();
        let mut right: Vec<Vector3<f64>> = points.iter().map(|(_, right)| -right).collect();
        for o in &self.observations {
            let Some(l) = self.linearise(o) else { continue };
            let mut along = l.by_lens * lens_step;
            if let Some(pose) = o.pose.checked_sub(1) {
                along += l.by_pose * Vector6::from_column_slice(&step.as_slice()[6 * pose..][..6]);
            }
            right[o.point] -= l.by_point.transpose() * along * huber(l.residual.norm_squared()).1;
        }
        for (point, ((inverse, _), right)) in next.points.iter_mut().zip(points.iter().zip(&right)) {
            *point += inverse * right;
        }
        for (pose, step) in next.poses.iter_mut().skip(1).zip(step.as_slice().chunks_exact(6)) {
            *pose = se3::exp(&Vector6::from_column_slice(step)) * *pose;
            pose.rotation.renormalize();
        }
        next.lens = Lens { focal: self.lens.focal * lens_step.x.exp(), k1: self.lens.k1 + lens_step.y };
        Some(next)
    }

    /// From the inverse of the undamped system, scaled by the residuals' variance.
    fn deviation(&self) -> Option<LensDeviation> {
        let Reduced { mut hessian, .. } = self.reduce(0.0);
        // The scale is free: held by little, it says nothing of the lens.
        (0..hessian.nrows()).for_each(|i| hessian[(i, i)] *= 1.0 + 1e-6);
        let unknowns = hessian.nrows();
        let factor = hessian.cholesky()?;
        let variance = |i: usize| {
            let mut unit = DVector::zeros(unknowns);
            unit[i] = 1.0;
            factor.solve(&unit)[i]
        };
        let (rms, inliers) = self.agreement();
        let points = self.observations.chunk_by(|a, b| a.point == b.point).count();
        let redundancy = (2 * inliers).checked_sub(3 * points + unknowns).filter(|n| *n > 0)?;
        let sigma = rms * (2.0 * inliers as f64 / redundancy as f64).sqrt();
        let [focal, k1] = [unknowns - 2, unknowns - 1].map(|i| sigma * variance(i).sqrt());
        (focal.is_finite() && k1.is_finite()).then_some(LensDeviation { focal, k1 })
    }
}

/// Adds a small matrix to a part of a large one.
fn add<R: nalgebra::Dim, C: nalgebra::Dim, S, const M: usize, const N: usize>(
    to: &mut nalgebra::Matrix<f64, R, C, S>,
    row: usize,
    column: usize,
    part: &SMatrix<f64, M, N>,
) where
    S: nalgebra::StorageMut<f64, R, C>,
{
    for (i, j) in (0..N).flat_map(|j| (0..M).map(move |i| (i, j))) {
        to[(row + i, column + j)] += part[(i, j)];
    }
}

/// Huber's cost of a squared residual, and the weight that it gives the residual.
fn huber(squared: f64) -> (f64, f64) {
    crate::tracking::solvers::residual::huber(squared, CHI2_PIXEL)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on an arc around a box of points, and what they measure.
    fn problem(noise: f64, seed: u64) -> (LensProblem, Lens) {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut uniform = |low: f64, high: f64| low + (high - low) * random.f64();
        let lens = Lens { focal: 520.0, k1: -0.08 };
        let points: Vec<Point3<f64>> =
            (0..300).map(|_| Point3::new(uniform(-1.5, 1.5), uniform(-1.2, 1.2), uniform(2.0, 4.5))).collect();
        let pose = |k: usize| {
            let t = k as f64 / 11.0;
            se3::exp(&Vector6::new(0.8 * t, 0.1 * (7.0 * t).sin(), 0.2 * t, 0.1 * t, -0.35 * t, 0.1 * (5.0 * t).cos()))
        };
        let poses: Vec<Se3> = (0..12).map(pose).collect();
        let mut observations = Vec::new();
        for (point, position) in points.iter().enumerate() {
            for (k, pose) in poses.iter().enumerate() {
                let pixel =
                    lens.project(&(pose * position).coords) + Vector2::new(uniform(-noise, noise), uniform(-noise, noise));
                observations.push(PixelObservation { pose: k, point, pixel, weight: 1.0 });
            }
        }
        (LensProblem { lens, poses, points, observations }, lens)
    }

    #[test]
    fn derivatives_are_the_numerical_ones() {
        let (problem, _) = problem(0.5, 1);
        for o in problem.observations.iter().filter(|o| o.pose > 0).step_by(97) {
            let l = problem.linearise(o).unwrap();
            let numeric = |change: &dyn Fn(&mut LensProblem, f64)| {
                let at = |h: f64| {
                    let mut moved = problem.clone();
                    change(&mut moved, h);
                    moved.residual(o).unwrap()
                };
                (at(1e-6) - at(-1e-6)) / 2e-6
            };
            assert!((numeric(&|p, h| p.lens.focal *= h.exp()) - l.by_lens.column(0)).norm() < 1e-4);
            assert!((numeric(&|p, h| p.lens.k1 += h) - l.by_lens.column(1)).norm() < 1e-4);
            for i in 0..6 {
                let mut unit = Vector6::zeros();
                unit[i] = 1.0;
                let moved = numeric(&|p, h| p.poses[o.pose] = se3::exp(&(unit * h)) * p.poses[o.pose]);
                assert!((moved - l.by_pose.column(i)).norm() < 1e-4);
            }
            for i in 0..3 {
                assert!((numeric(&|p, h| p.points[o.point][i] += h) - l.by_point.column(i)).norm() < 1e-4);
            }
        }
    }

    #[test]
    fn a_lens_is_found_and_its_deviation_covers_the_error() {
        for (noise, tolerance, seed) in [(0.0, 1e-5, 1), (1.0, 0.02, 2), (1.0, 0.02, 3), (1.0, 0.02, 4), (1.0, 0.02, 5)] {
            let (mut problem, truth) = problem(noise, seed);
            problem.lens = Lens { focal: 450.0, k1: 0.0 };
            // A wrong pixel or two.
            problem.observations.iter_mut().step_by(150).for_each(|o| o.pixel.x += 60.0);
            problem.solve(40);
            problem.drop_outliers();
            let deviation = problem.solve(40).unwrap();
            let error = (problem.lens.focal / truth.focal - 1.0).abs();
            assert!(error < tolerance && error <= 4.0 * deviation.focal + 1e-5, "{:?} {deviation:?}", problem.lens);
            assert!((problem.lens.k1 - truth.k1).abs() < 4.0 * deviation.k1 + 1e-4 && deviation.focal < 0.02);
        }
    }
}
