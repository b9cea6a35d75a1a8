//! Bundle adjustment that also estimates the focal length and the distortion of the one camera, two radial and two tangential terms, and the readout
//! time of its rolling shutter: Levenberg-Marquardt on pixels as they were recorded, with the points eliminated (Triggs et al., *Bundle adjustment: a
//! modern synthesis*, 2000; Brown, *Close-range camera calibration*, 1971; Hedborg et al., *Rolling shutter bundle adjustment*, CVPR 2012).
//!
//! For one or two hundred poses: the reduced system is dense. The first pose stays; the scale is free, and damping alone holds it.

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix2x6, Matrix3, Point3, SMatrix, SVector, Vector2, Vector3, Vector6};

use crate::geometry::se3::skew;
use crate::geometry::{Distortion, Se3, se3};
use crate::tracking::solvers::residual::point_by_pose;

/// 95% of true pixels lie below this squared error, standard deviations (χ², 2 degrees of freedom).
const CHI2_PIXEL: f64 = 5.991;
const MAX_LAMBDA: f64 = 1e8;
const CONVERGED_SHARE: f64 = 1e-7;
/// Stretches of the recording that are left out in turn.
const PARTS: usize = 4;

/// What is estimated of the camera. Each term that is left out, the focal length makes up for in part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Pixels, along both axes.
    pub focal: f64,
    /// All but k3.
    pub distortion: Distortion,
    /// Time from the first row to the last one, intervals between two frames; 0 for a global shutter.
    pub readout: f64,
}

/// The logarithm of the focal length, k1, k2, p1, p2, and the readout time.
const TERMS: usize = 6;
/// Standard deviations of k2, p1, p2 and the readout time over usual cameras, for views that say little of them.
const USUAL: [f64; 4] = [0.3, 0.003, 0.003, 0.5];

impl Lens {
    /// The recorded pixel, relative to the principal point, of a point in the camera frame.
    fn project(&self, p: &Vector3<f64>) -> Vector2<f64> {
        self.distortion.distort(&(p.xy() / p.z)) * self.focal
    }

    /// Changed by a step of the terms.
    fn stepped(&self, step: &SVector<f64, TERMS>) -> Self {
        let Distortion { k1, k2, p1, p2, k3 } = self.distortion;
        let distortion = Distortion { k1: k1 + step[1], k2: k2 + step[2], p1: p1 + step[3], p2: p2 + step[4], k3 };
        Self { focal: self.focal * step[0].exp(), distortion, readout: self.readout + step[5] }
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
    /// camera_from_world, when the middle row was read.
    pub poses: Vec<Se3>,
    /// How each pose changes between two frames, as a left perturbation of `camera_from_world`.
    pub motions: Vec<Vector6<f64>>,
    /// Rows of an image, pixels.
    pub height: f64,
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
    by_lens: SMatrix<f64, 2, TERMS>,
}

/// The reduced system of poses and lens, and what gives the points' steps.
struct Reduced {
    hessian: DMatrix<f64>,
    gradient: DVector<f64>,
    points: Vec<(Matrix3<f64>, Vector3<f64>)>,
}

impl LensProblem {
    /// When an observation's row was read, after the middle one, by readout times.
    fn row(&self, o: &PixelObservation) -> f64 {
        o.pixel.y / self.height
    }

    /// The point in the camera frame when its row was read.
    fn in_camera(&self, o: &PixelObservation) -> Vector3<f64> {
        let p = (self.poses[o.pose] * self.points[o.point]).coords;
        p + point_by_pose(&p) * self.motions[o.pose] * (self.lens.readout * self.row(o))
    }

    fn residual(&self, o: &PixelObservation) -> Option<Vector2<f64>> {
        let p = self.in_camera(o);
        (p.z > 1e-3).then(|| (self.lens.project(&p) - o.pixel) * o.weight)
    }

    fn linearise(&self, o: &PixelObservation) -> Option<Linearised> {
        let pose = &self.poses[o.pose];
        let at_middle = (pose * self.points[o.point]).coords;
        let (p, motion) = (self.in_camera(o), &self.motions[o.pose]);
        let residual = self.residual(o)?;
        let n = p.xy() / p.z;
        let (r2, scale) = (n.norm_squared(), self.lens.focal * o.weight);
        let Distortion { k1, k2, p1, p2, .. } = self.lens.distortion;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        let mixed = 2.0 * (p1 * n.x + p2 * n.y);
        let tangential = Matrix2::new(2.0 * p1 * n.y + 6.0 * p2 * n.x, mixed, mixed, 6.0 * p1 * n.y + 2.0 * p2 * n.x);
        let by_normalised = Matrix2::identity() * radial + n * n.transpose() * (2.0 * k1 + 4.0 * k2 * r2) + tangential;
        let by_camera_point = by_normalised * Matrix2x3::new(1.0, 0.0, -n.x, 0.0, 1.0, -n.y) * (scale / p.z);
        let turned = Matrix3::identity() + skew(&motion.fixed_rows::<3>(3).into()) * (self.lens.readout * self.row(o));
        let by_middle = by_camera_point * turned;
        Some(Linearised {
            residual,
            by_pose: by_middle * point_by_pose(&at_middle),
            by_point: by_middle * pose.rotation.to_rotation_matrix().matrix(),
            by_lens: SMatrix::from_columns(&[
                self.lens.distortion.distort(&n) * scale,
                n * (r2 * scale),
                n * (r2 * r2 * scale),
                Vector2::new(2.0 * n.x * n.y, r2 + 2.0 * n.y * n.y) * scale,
                Vector2::new(r2 + 2.0 * n.x * n.x, 2.0 * n.x * n.y) * scale,
                by_camera_point * point_by_pose(&at_middle) * motion * self.row(o),
            ]),
        })
    }

    /// Robust cost; infinite if a point lies behind a camera that sees it.
    fn cost(&self) -> f64 {
        let of = |o: &PixelObservation| self.residual(o).map_or(f64::INFINITY, |r| huber(r.norm_squared()).0);
        let prior: f64 = self.priors().iter().map(|(_, value, sigma)| (value / sigma).powi(2)).sum();
        self.observations.iter().map(of).sum::<f64>() + prior
    }

    /// Terms that are about 0 in usual cameras: their place, value and standard deviation.
    fn priors(&self) -> [(usize, f64, f64); 4] {
        let Distortion { k2, p1, p2, .. } = self.lens.distortion;
        [(2, k2, USUAL[0]), (3, p1, USUAL[1]), (4, p2, USUAL[2]), (5, self.lens.readout, USUAL[3])]
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
        self.drop_seen_twice();
    }

    /// Takes `steps` Levenberg-Marquardt steps at most.
    pub fn solve(&mut self, steps: usize) {
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
    }

    /// How sure a solved lens is: by the residuals, or by what it would be without a part of the views, whichever says less. `None` if the
    /// system says nothing of it.
    pub fn deviation(&self, steps: usize) -> Option<LensDeviation> {
        let (stated, shown) = (self.deviation_by_residuals()?, self.deviation_by_parts(steps));
        Some(LensDeviation { focal: stated.focal.max(shown.focal), k1: stated.k1.max(shown.k1) })
    }

    /// Delete-a-group jackknife (Efron & Tibshirani, *An introduction to the bootstrap*, 1993) over stretches of the recording: what neighbouring
    /// views have in common, such as motion blur or a rolling shutter, shows between them and not in the residuals.
    fn deviation_by_parts(&self, steps: usize) -> LensDeviation {
        let size = self.poses.len().div_ceil(PARTS);
        let lenses: Vec<Lens> =
            (0..self.poses.len()).step_by(size).map(|start| self.without(start..start + size, steps)).collect();
        let deviation = |of: &dyn Fn(&Lens) -> f64| {
            let count = lenses.len() as f64;
            let mean = lenses.iter().map(of).sum::<f64>() / count;
            ((count - 1.0) / count * lenses.iter().map(|lens| (of(lens) - mean).powi(2)).sum::<f64>()).sqrt()
        };
        LensDeviation { focal: deviation(&|lens| lens.focal.ln()), k1: deviation(&|lens| lens.distortion.k1) }
    }

    /// The lens without the views of some poses.
    fn without(&self, poses: std::ops::Range<usize>, steps: usize) -> Lens {
        let mut rest = self.clone();
        let gone = poses.start..poses.end.min(self.poses.len());
        rest.poses.drain(gone.clone());
        rest.motions.drain(gone);
        rest.observations.retain(|o| !poses.contains(&o.pose));
        rest.observations.iter_mut().filter(|o| o.pose >= poses.end).for_each(|o| o.pose -= poses.len());
        rest.drop_seen_twice();
        rest.solve(steps);
        rest.lens
    }

    /// Leaves out points that two views see at most: they say little.
    fn drop_seen_twice(&mut self) {
        let mut seen = vec![0; self.points.len()];
        self.observations.iter().for_each(|o| seen[o.point] += 1);
        self.observations.retain(|o| seen[o.point] > 2);
    }

    /// Normal equations with the points eliminated; `lambda` damps both.
    fn reduce(&self, lambda: f64) -> Reduced {
        let unknowns = 6 * (self.poses.len() - 1) + TERMS;
        let lens_at = unknowns - TERMS;
        let mut hessian = DMatrix::zeros(unknowns, unknowns);
        let mut gradient = DVector::zeros(unknowns);
        let mut points = vec![(Matrix3::zeros(), Vector3::zeros()); self.points.len()];
        for group in self.observations.chunk_by(|a, b| a.point == b.point) {
            let (mut by_points, mut right) = (Matrix3::<f64>::zeros(), Vector3::<f64>::zeros());
            let mut mixed: Vec<(usize, SMatrix<f64, 6, 3>)> = Vec::new();
            let mut lens_mixed = SMatrix::<f64, TERMS, 3>::zeros();
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
        for (term, value, sigma) in self.priors() {
            hessian[(lens_at + term, lens_at + term)] += sigma.powi(-2);
            gradient[lens_at + term] += value * sigma.powi(-2);
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
        let lens_step = SVector::<f64, TERMS>::from_column_slice(&step.as_slice()[step.len() - TERMS..]);
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
        next.lens = self.lens.stepped(&lens_step);
        Some(next)
    }

    /// From the inverse of the undamped system, scaled by the residuals' variance.
    fn deviation_by_residuals(&self) -> Option<LensDeviation> {
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
        let [focal, k1] = [unknowns - TERMS, unknowns - TERMS + 1].map(|i| sigma * variance(i).sqrt());
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
#[path = "intrinsics_tests.rs"]
mod tests;
