//! Normal equations of one camera's pose, four observations at a time, in the widest vectors of the processor. Sums run in a fixed order: they do not
//! depend on the processor. `pose.rs` solves them.

use std::ops::{Add, AddAssign, Mul, Neg, Sub};

use nalgebra::{Matrix6, Vector6};
use pulp::{Arch, Simd};

use crate::geometry::{Pinhole, Se3};
use crate::tracking::solvers::pose::PoseObservation;
use crate::tracking::solvers::residual::{CHI2_PIXEL, HUBER_DEPTH, InlierClass, NEAR_METRES};

/// Cost of a point behind the camera: that of a far outlier, so that no step gains by losing it.
const BEHIND_COST: f64 = 1e4;
const LANES: usize = 4;
/// Of the lower triangle of a Hessian of six unknowns.
const ENTRIES: usize = 21;

/// A number of each of four observations.
#[derive(Clone, Copy, Debug)]
struct Lanes([f64; LANES]);

/// Four observations as far as they are trusted.
#[derive(Clone, Copy, Debug)]
struct Group {
    point_in_world: [Lanes; 3],
    pixel: [Lanes; 2],
    inverse_depth: Lanes,
    /// 0 where there is no trusted observation.
    pixel_weight: Lanes,
    /// 0 where there is no trusted depth.
    depth_weight: Lanes,
    /// What the observation costs behind the camera.
    behind_cost: Lanes,
}

/// Observations in groups.
#[derive(Clone, Debug)]
pub struct GroupedObservations {
    groups: Vec<Group>,
    /// Whether residuals go through Huber's kernel.
    robust: bool,
}

/// Normal equations of a left perturbation of `camera_from_world` (metres, radians).
#[derive(Clone, Copy, Debug)]
pub struct NormalEquations {
    pub hessian: Matrix6<f64>,
    pub gradient: Vector6<f64>,
    pub cost: f64,
}

impl GroupedObservations {
    /// Observations as far as their classes trust them.
    pub fn new(observations: &[PoseObservation], classes: &[InlierClass], robust: bool) -> Self {
        let mut groups = Vec::with_capacity(observations.len().div_ceil(LANES));
        for (observations, classes) in observations.chunks(LANES).zip(classes.chunks(LANES)) {
            groups.push(Group::new(observations, classes));
        }
        Self { groups, robust }
    }

    /// The cost at a pose.
    pub fn cost(&self, pinhole: &Pinhole, camera_from_world: &Se3) -> f64 {
        cost(&Evaluation::new(self, pinhole, camera_from_world))
    }

    /// Normal equations and [`Self::cost`] at a pose.
    pub fn linearise(&self, pinhole: &Pinhole, camera_from_world: &Se3) -> NormalEquations {
        linearise(&Evaluation::new(self, pinhole, camera_from_world))
    }
}

impl Group {
    fn new(observations: &[PoseObservation], classes: &[InlierClass]) -> Self {
        let mut group = Self {
            point_in_world: [Lanes::all(0.0); 3],
            pixel: [Lanes::all(0.0); 2],
            inverse_depth: Lanes::all(0.0),
            pixel_weight: Lanes::all(0.0),
            depth_weight: Lanes::all(0.0),
            behind_cost: Lanes::all(0.0),
        };
        for (l, (o, class)) in observations.iter().zip(classes).enumerate() {
            let Some(measurement) = o.measurement.restricted_to(*class) else { continue };
            (0..3).for_each(|k| group.point_in_world[k].0[l] = o.point_in_world[k]);
            (0..2).for_each(|k| group.pixel[k].0[l] = measurement.pixel[k]);
            group.pixel_weight.0[l] = measurement.pixel_weight;
            group.behind_cost.0[l] = BEHIND_COST;
            if let Some(inverse_depth) = measurement.inverse_depth {
                group.inverse_depth.0[l] = inverse_depth;
                group.depth_weight.0[l] = measurement.depth_weight;
            }
        }
        group
    }
}

/// Observations seen from a pose.
struct Evaluation<'a> {
    groups: &'a [Group],
    robust: bool,
    focal: [Lanes; 2],
    centre: [Lanes; 2],
    rotation: [[Lanes; 3]; 3],
    translation: [Lanes; 3],
}

/// A group seen from a pose. The formulas are those of `residual.rs`.
struct Terms {
    p_in_camera: [Lanes; 3],
    inverse_z: Lanes,
    pixel_weight: Lanes,
    depth_weight: Lanes,
    residual: [Lanes; 3],
    robust_pixel: Lanes,
    robust_depth: Lanes,
    cost: Lanes,
}

impl<'a> Evaluation<'a> {
    fn new(observations: &'a GroupedObservations, pinhole: &Pinhole, pose: &Se3) -> Self {
        let rotation = pose.rotation.to_rotation_matrix();
        let row = |i: usize| [0, 1, 2].map(|j| Lanes::all(rotation[(i, j)]));
        Self {
            groups: &observations.groups,
            robust: observations.robust,
            focal: [pinhole.fx, pinhole.fy].map(Lanes::all),
            centre: [pinhole.cx, pinhole.cy].map(Lanes::all),
            rotation: [row(0), row(1), row(2)],
            translation: [0, 1, 2].map(|k| Lanes::all(pose.translation.vector[k])),
        }
    }

    #[inline(always)]
    fn terms(&self, group: &Group) -> Terms {
        let [x, y, z] = group.point_in_world;
        let mut p_in_camera = self.translation;
        for (p, row) in p_in_camera.iter_mut().zip(&self.rotation) {
            *p = row[0] * x + row[1] * y + row[2] * z + *p;
        }
        let (none, one, near) = (Lanes::all(0.0), Lanes::all(1.0), Lanes::all(NEAR_METRES));
        let depth = p_in_camera[2];
        // What is not in front, as NaN is not, adds zeros.
        p_in_camera.iter_mut().zip([none, none, one]).for_each(|(p, other)| *p = depth.where_above(near, *p, other));
        let [x, y, z] = p_in_camera;
        let inverse_z = one.over(z);
        let pixel_weight = depth.where_above(near, group.pixel_weight, none);
        let depth_weight = depth.where_above(near, group.depth_weight, none);
        let residual = [
            (self.focal[0] * x * inverse_z + self.centre[0] - group.pixel[0]) * pixel_weight,
            (self.focal[1] * y * inverse_z + self.centre[1] - group.pixel[1]) * pixel_weight,
            (inverse_z - group.inverse_depth) * depth_weight,
        ];
        let squared_pixel = residual[0] * residual[0] + residual[1] * residual[1];
        let squared_depth = residual[2] * residual[2];
        let ((pixel_cost, robust_pixel), (depth_cost, robust_depth)) = if self.robust {
            (squared_pixel.huber(CHI2_PIXEL), squared_depth.huber(HUBER_DEPTH))
        } else {
            ((squared_pixel, one), (squared_depth, one))
        };
        let cost = pixel_cost + depth_cost + depth.where_above(near, none, group.behind_cost);
        Terms { p_in_camera, inverse_z, pixel_weight, depth_weight, residual, robust_pixel, robust_depth, cost }
    }
}

#[pulp::with_simd(cost = Arch::new())]
#[inline(always)]
fn cost_with<'a, S: Simd>(_: S, evaluation: &'a Evaluation<'a>) -> f64 {
    let mut cost = Lanes::all(0.0);
    for group in evaluation.groups {
        cost += evaluation.terms(group).cost;
    }
    cost.sum()
}

#[pulp::with_simd(linearise = Arch::new())]
#[inline(always)]
fn linearise_with<'a, S: Simd>(_: S, evaluation: &'a Evaluation<'a>) -> NormalEquations {
    let mut sums = Sums { hessian: [Lanes::all(0.0); ENTRIES], gradient: [Lanes::all(0.0); 6] };
    let mut cost = Lanes::all(0.0);
    for group in evaluation.groups {
        let t = evaluation.terms(group);
        let [x, y, z] = t.p_in_camera;
        let [a, c] = [0, 1].map(|k| evaluation.focal[k] * t.inverse_z * t.pixel_weight);
        let (b, d) = (-(a * x * t.inverse_z), -(c * y * t.inverse_z));
        let e = -(t.inverse_z * t.inverse_z * t.depth_weight);
        // Rows of the Jacobian; the other entries are zero.
        sums.add_row([0, 2, 3, 4, 5], [a, b, b * y, a * z - b * x, -(a * y)], t.robust_pixel, t.residual[0]);
        sums.add_row([1, 2, 3, 4, 5], [c, d, d * y - c * z, -(d * x), c * x], t.robust_pixel, t.residual[1]);
        sums.add_row([2, 3, 4], [e, e * y, -(e * x)], t.robust_depth, t.residual[2]);
        cost += t.cost;
    }
    let mut hessian = Matrix6::zeros();
    for row in 0..6 {
        for column in 0..=row {
            hessian[(row, column)] = sums.hessian[entry(row, column)].sum();
        }
    }
    hessian.fill_upper_triangle_with_lower_triangle();
    NormalEquations { hessian, gradient: Vector6::from_fn(|k, _| sums.gradient[k].sum()), cost: cost.sum() }
}

struct Sums {
    hessian: [Lanes; ENTRIES],
    gradient: [Lanes; 6],
}

impl Sums {
    /// Adds a row of the Jacobian by its entries in some columns.
    #[inline(always)]
    fn add_row<const N: usize>(&mut self, columns: [usize; N], row: [Lanes; N], weight: Lanes, residual: Lanes) {
        for i in 0..N {
            let weighted = row[i] * weight;
            self.gradient[columns[i]] += weighted * residual;
            for j in 0..=i {
                self.hessian[entry(columns[i], columns[j])] += weighted * row[j];
            }
        }
    }
}

/// The place of an entry of the lower triangle.
#[inline(always)]
const fn entry(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}

impl Lanes {
    #[inline(always)]
    fn all(value: f64) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    fn with(self, other: Self, of: impl Fn(f64, f64) -> f64) -> Self {
        let mut lanes = self;
        for l in 0..LANES {
            lanes.0[l] = of(self.0[l], other.0[l]);
        }
        lanes
    }

    #[inline(always)]
    fn over(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }

    /// Lanes of `then` where this is above the limit, of `otherwise` elsewhere.
    #[inline(always)]
    fn where_above(self, limit: Self, then: Self, otherwise: Self) -> Self {
        let mut lanes = self;
        for l in 0..LANES {
            lanes.0[l] = if self.0[l] > limit.0[l] { then.0[l] } else { otherwise.0[l] };
        }
        lanes
    }

    /// [`huber`](crate::tracking::solvers::residual::huber) of squared residuals.
    #[inline(always)]
    fn huber(self, threshold: f64) -> (Self, Self) {
        let threshold = Self::all(threshold);
        let ratio = threshold.with(self, |threshold, squared| (threshold / squared).sqrt());
        let outside = Self::all(2.0) * self * ratio - threshold;
        (self.where_above(threshold, outside, self), self.where_above(threshold, ratio, Self::all(1.0)))
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        (self.0[0] + self.0[1]) + (self.0[2] + self.0[3])
    }
}

impl Add for Lanes {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
}

impl AddAssign for Lanes {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sub for Lanes {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
}

impl Mul for Lanes {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
}

impl Neg for Lanes {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        self.with(self, |a, _| -a)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector2, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::se3;
    use crate::tracking::solvers::residual::Measurement;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    /// Observations of all classes, some behind the camera.
    fn observations(random: &mut fastrand::Rng, count: usize) -> (Vec<PoseObservation>, Vec<InlierClass>) {
        let mut number = |low: f64, high: f64| low + (high - low) * random.f64();
        let observation = |i: usize| PoseObservation {
            point_in_world: Point3::new(
                number(-1.0, 1.0),
                number(-1.0, 1.0),
                number(if i.is_multiple_of(7) { -2.0 } else { 1.0 }, 4.0),
            ),
            measurement: Measurement {
                pixel: Vector2::new(number(0.0, 640.0), number(0.0, 480.0)),
                inverse_depth: (!i.is_multiple_of(3)).then(|| number(0.2, 1.0)),
                pixel_weight: number(0.02, 1.0),
                depth_weight: number(1.0, 40.0),
            },
        };
        let classes = [InlierClass::Full, InlierClass::PixelOnly, InlierClass::Outlier, InlierClass::Full, InlierClass::Full];
        ((0..count).map(observation).collect(), (0..count).map(|i| classes[i % 5]).collect())
    }

    proptest! {
        #[test]
        fn sums_are_those_of_single_observations(seed: u64, count in 0usize..30, robust: bool, tau in prop::array::uniform6(-0.3f64..0.3)) {
            let (observations, classes) = observations(&mut fastrand::Rng::with_seed(seed), count);
            let pose = se3::exp(&Vector6::from(tau));
            let (mut hessian, mut gradient, mut cost) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
            for (o, class) in observations.iter().zip(&classes) {
                let Some(measurement) = o.measurement.restricted_to(*class) else { continue };
                let p = (pose * o.point_in_world).coords;
                let Some(residual) = measurement.residual(&PINHOLE, &p) else {
                    cost += BEHIND_COST;
                    continue;
                };
                let plain = (residual.norm_squared(), Vector3::repeat(1.0));
                let (rho, weights) = if robust { Measurement::robust(&residual) } else { plain };
                let j = measurement.jacobian_by_pose(&PINHOLE, &p);
                let weighted = j.transpose() * nalgebra::Matrix3::from_diagonal(&weights);
                (hessian, gradient, cost) = (hessian + weighted * j, gradient + weighted * residual, cost + rho);
            }
            let grouped = GroupedObservations::new(&observations, &classes, robust);
            let found = grouped.linearise(&PINHOLE, &pose);
            prop_assert!((found.hessian - hessian).norm() <= 1e-12 * (1.0 + hessian.norm()));
            prop_assert!((found.gradient - gradient).norm() <= 1e-12 * (1.0 + gradient.norm()));
            prop_assert!((found.cost - cost).abs() <= 1e-12 * (1.0 + cost));
            prop_assert_eq!(grouped.cost(&PINHOLE, &pose), found.cost);
        }
    }

    #[test]
    fn a_point_that_is_not_finite_costs_as_one_behind_the_camera() {
        let (mut observations, _) = observations(&mut fastrand::Rng::with_seed(1), 2);
        observations[1].point_in_world.x = f64::NAN;
        let classes = [InlierClass::Full; 2];
        let at = |k: usize| GroupedObservations::new(&observations[k..=k], &classes[..1], true).cost(&PINHOLE, &Se3::identity());
        assert_eq!(at(1), BEHIND_COST);
    }
}
