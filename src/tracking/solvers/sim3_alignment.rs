//! The similarity between two keyframes from points that both know, each in its own frame: RANSAC over three points (Umeyama's closed
//! form), then Levenberg-Marquardt over the reprojections in both images (Mur-Artal & Tardós, *Visual-inertial monocular SLAM with map
//! reuse*, 2017, sec. on Sim(3); ours also weighs measured depths).
//!
//! SE(3) where the sensor knows the scale: then the scale stays 1. Where it does not, reprojections alone say nothing of the scale if both
//! keyframes stand in one place, as they do where a loop closes: there the points' own distances count as weakly measured ones.
//! The random numbers have a fixed seed.

use nalgebra::{Matrix3, Point3, SMatrix, Vector3};

use crate::geometry::se3::skew;
use crate::geometry::sim3::{self, Matrix7, Vector7};
use crate::geometry::{Pinhole, Sim3, align};
use crate::tracking::solvers::residual::{InlierClass, Measurement};

type Matrix3x7 = SMatrix<f64, 3, 7>;

const SEED: u64 = 17;
const MINIMAL_SET: usize = 3;
const MAX_DRAWS: usize = 300;
/// RANSAC ends when a better set has been missed with less than this probability.
const MISSED: f64 = 1e-3;
/// Three noisy points give a rough answer: its errors may be this much larger.
const ROUGH_FACTOR: f64 = 3.0;
/// Fewer pairs than this agree by chance.
const MIN_INLIERS: usize = 8;
/// Standard deviation of the distance of a point in a keyframe without depth, as a share of it. Common errors of all points are
/// the scale that is looked for; this is what remains of each.
const KNOWN_DISTANCE_SIGMA: f64 = 0.1;
const ROUNDS: usize = 3;
const STEPS_PER_ROUND: usize = 6;

/// A point that both keyframes know, in their frames and as their features measured it.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    pub p_in_a: Point3<f64>,
    pub p_in_b: Point3<f64>,
    pub in_a: Measurement,
    pub in_b: Measurement,
}

/// a_from_b, the motion between two keyframes; `None` if too few pairs agree on one in both images.
pub fn align_pairs(pairs: &[Pair], pinhole: &Pinhole, scale_is_free: bool) -> Option<Sim3> {
    let mut a_from_b = draw_best(pairs, pinhole, scale_is_free)?;
    let pairs: Vec<Pair> = pairs.iter().map(|pair| if scale_is_free { pair.with_known_distances() } else { *pair }).collect();
    for _ in 0..ROUNDS {
        let classes: Vec<[InlierClass; 2]> = pairs.iter().map(|pair| pair.classify(pinhole, &a_from_b)).collect();
        a_from_b = refine(&pairs, &classes, pinhole, &a_from_b, scale_is_free);
    }
    let inliers = pairs.iter().filter(|pair| agrees(&pair.classify(pinhole, &a_from_b))).count();
    (inliers >= MIN_INLIERS).then_some(a_from_b)
}

fn agrees(classes: &[InlierClass; 2]) -> bool {
    classes.iter().all(|t| *t != InlierClass::Outlier)
}

/// RANSAC: the motion from three pairs with which most of the others agree.
fn draw_best(pairs: &[Pair], pinhole: &Pinhole, scale_is_free: bool) -> Option<Sim3> {
    if pairs.len() < MIN_INLIERS {
        return None;
    }
    let mut random = fastrand::Rng::with_seed(SEED);
    let lenient: Vec<Pair> = pairs.iter().map(Pair::lenient).collect();
    let mut best: Option<(usize, Sim3)> = None;
    let (mut draws, mut needed) = (0, MAX_DRAWS);
    while draws < needed {
        draws += 1;
        let chosen: [usize; MINIMAL_SET] = std::array::from_fn(|_| random.usize(..pairs.len()));
        let from = chosen.map(|i| pairs[i].p_in_b.coords);
        let to = chosen.map(|i| pairs[i].p_in_a.coords);
        let Some(candidate) = align(&from, &to, scale_is_free).filter(|s| s.scale > 0.0 && s.scale.is_finite()) else { continue };
        let count = lenient.iter().filter(|pair| agrees(&pair.classify(pinhole, &candidate))).count();
        if best.is_none_or(|(most, _)| count > most) {
            best = Some((count, candidate));
            let all_good = (count as f64 / pairs.len() as f64).powi(MINIMAL_SET as i32).clamp(1e-9, 1.0 - 1e-9);
            needed = ((MISSED.ln() / (1.0 - all_good).ln()).ceil() as usize).clamp(1, MAX_DRAWS);
        }
    }
    best.filter(|(count, _)| *count >= MIN_INLIERS).map(|(_, a_from_b)| a_from_b)
}

/// Levenberg-Marquardt over the trusted measurements of pairs that agree in both images.
fn refine(pairs: &[Pair], classes: &[[InlierClass; 2]], pinhole: &Pinhole, initial: &Sim3, scale_is_free: bool) -> Sim3 {
    let used: Vec<(&Pair, &[InlierClass; 2])> = pairs.iter().zip(classes).filter(|(_, t)| agrees(t)).collect();
    let mut a_from_b = *initial;
    let (mut hessian, mut gradient, mut cost) = normal_equations(&used, pinhole, &a_from_b);
    let mut lambda = 1e-4;
    for _ in 0..STEPS_PER_ROUND {
        let mut damped = hessian;
        (0..7).for_each(|k| damped[(k, k)] += lambda * hessian[(k, k)] + 1e-9);
        if !scale_is_free {
            damped.fixed_view_mut::<6, 1>(0, 6).fill(0.0);
            damped.fixed_view_mut::<1, 6>(6, 0).fill(0.0);
            gradient[6] = 0.0;
        }
        let Some(step) = damped.cholesky().map(|c| c.solve(&-gradient)) else { break };
        let candidate = sim3::exp(&step) * a_from_b;
        let (h, g, candidate_cost) = normal_equations(&used, pinhole, &candidate);
        if candidate_cost < cost {
            (a_from_b, hessian, gradient, cost) = (candidate, h, g, candidate_cost);
            lambda *= 0.1;
        } else {
            lambda *= 10.0;
        }
    }
    a_from_b.rotation.renormalize();
    a_from_b
}

/// Hessian, gradient and robust cost; infinite if a point falls behind a camera.
fn normal_equations(used: &[(&Pair, &[InlierClass; 2])], pinhole: &Pinhole, a_from_b: &Sim3) -> (Matrix7, Vector7, f64) {
    let (mut hessian, mut gradient, mut cost) = (Matrix7::zeros(), Vector7::zeros(), 0.0);
    for (pair, classes) in used {
        for (term, class) in pair.linearise(pinhole, a_from_b, classes).into_iter().zip(*classes) {
            let Some((residual, by_step)) = term else {
                cost += if *class == InlierClass::Outlier { 0.0 } else { f64::INFINITY };
                continue;
            };
            let (rho, weights) = Measurement::robust(&residual);
            let weighted = by_step.transpose() * Matrix3::from_diagonal(&weights);
            hessian += weighted * by_step;
            gradient += weighted * residual;
            cost += rho;
        }
    }
    (hessian, gradient, cost)
}

impl Pair {
    /// In a's image, and in b's.
    fn classify(&self, pinhole: &Pinhole, a_from_b: &Sim3) -> [InlierClass; 2] {
        let in_a = self.in_a.classify(pinhole, &a_from_b.act(&self.p_in_b).coords);
        let in_b = self.in_b.classify(pinhole, &a_from_b.inverse().act(&self.p_in_a).coords);
        [in_a, in_b]
    }

    /// The same; where no depth was measured, the landmark's own depth stands in.
    fn with_known_distances(&self) -> Self {
        let known = |m: Measurement, depth: f64| match m.inverse_depth {
            Some(_) => m,
            None => Measurement { inverse_depth: Some(1.0 / depth), depth_weight: depth / KNOWN_DISTANCE_SIGMA, ..m },
        };
        Self { in_a: known(self.in_a, self.p_in_a.z), in_b: known(self.in_b, self.p_in_b.z), ..*self }
    }

    /// Classifies with larger errors allowed.
    fn lenient(&self) -> Self {
        let loosen = |m: Measurement| Measurement {
            pixel_weight: m.pixel_weight / ROUGH_FACTOR,
            depth_weight: m.depth_weight / ROUGH_FACTOR,
            ..m
        };
        Self { in_a: loosen(self.in_a), in_b: loosen(self.in_b), ..*self }
    }

    /// Residuals in a's and b's image, and their derivatives by a left perturbation of `a_from_b`.
    fn linearise(
        &self,
        pinhole: &Pinhole,
        a_from_b: &Sim3,
        classes: &[InlierClass; 2],
    ) -> [Option<(Vector3<f64>, Matrix3x7)>; 2] {
        let in_a = || {
            let (measurement, p) = (self.in_a.restricted_to(classes[0])?, a_from_b.act(&self.p_in_b).coords);
            let residual = measurement.residual(pinhole, &p)?;
            Some((residual, measurement.jacobian(pinhole, &p) * point_by_similarity(&p)))
        };
        let in_b = || {
            let inverse = a_from_b.inverse();
            let (measurement, p) = (self.in_b.restricted_to(classes[1])?, inverse.act(&self.p_in_a).coords);
            let residual = measurement.residual(pinhole, &p)?;
            let turned = inverse.rotation.to_rotation_matrix().matrix() * inverse.scale;
            let by_step = turned * -point_by_similarity(&self.p_in_a.coords);
            Some((residual, measurement.jacobian(pinhole, &p) * by_step))
        };
        [in_a(), in_b()]
    }
}

/// Derivative of `Exp(τ)·p` at 0.
fn point_by_similarity(p: &Vector3<f64>) -> Matrix3x7 {
    let mut d = Matrix3x7::zeros();
    d.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
    d.fixed_view_mut::<3, 3>(0, 3).copy_from(&-skew(p));
    d.fixed_view_mut::<3, 1>(0, 6).copy_from(p);
    d
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::Vector2;
    use proptest::prelude::*;

    fn gauss(random: &mut fastrand::Rng) -> f64 {
        (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
    }

    /// 120 points seen from both sides with noise; `wrong` of 5 are paired falsely.
    fn pairs(b_from_a: &Sim3, with_depth: bool, wrong: usize) -> Vec<Pair> {
        let mut random = fastrand::Rng::with_seed(3);
        let mut pairs = Vec::new();
        while pairs.len() < 120 {
            let pixel = Vector2::new(640.0 * random.f64(), 480.0 * random.f64());
            let p_in_a = Point3::from(PINHOLE.unproject(&pixel, 1.5 + 2.0 * random.f64()));
            let p_in_b = b_from_a.act(&p_in_a);
            let Some(in_b) = PINHOLE.project(&p_in_b.coords).filter(|p| PINHOLE.contains(p, 0.0)) else { continue };
            let mut measure = |pixel: Vector2<f64>, z: f64| Measurement {
                pixel: pixel + Vector2::new(gauss(&mut random), gauss(&mut random)) * 0.5,
                inverse_depth: with_depth.then(|| 1.0 / z + 0.01 * gauss(&mut random)),
                pixel_weight: 1.0,
                depth_weight: 50.0,
            };
            let (in_a, in_b) = (measure(pixel, p_in_a.z), measure(in_b, p_in_b.z));
            pairs.push(Pair { p_in_a, p_in_b, in_a, in_b });
        }
        for i in (0..pairs.len()).filter(|i| i % 5 < wrong) {
            let other = pairs[(i + 7) % 120];
            (pairs[i].p_in_b, pairs[i].in_b) = (other.p_in_b, other.in_b);
        }
        // What a keyframe knows of a point is not exact either.
        for pair in &mut pairs {
            let near = |p: &Point3<f64>, random: &mut fastrand::Rng| p + Vector3::from_fn(|_, _| 0.003 * gauss(random));
            (pair.p_in_a, pair.p_in_b) = (near(&pair.p_in_a, &mut random), near(&pair.p_in_b, &mut random));
        }
        pairs
    }

    #[test]
    fn finds_the_motion_among_false_pairs_with_and_without_scale() {
        for (scale, scale_is_free) in [(1.0, false), (1.4, true)] {
            let rigid = sim3::exp(&Vector7::from_column_slice(&[0.3, -0.1, 0.2, 0.1, 0.25, -0.1, 0.0]));
            let b_from_a = Sim3 { scale, ..rigid };
            let found = align_pairs(&pairs(&b_from_a, !scale_is_free, 3), &PINHOLE, scale_is_free).unwrap();
            let error = sim3::log(&(found * b_from_a));
            assert!(error.norm() < 0.01, "{error}");
            assert!(scale_is_free || found.scale == 1.0);
        }
    }

    #[test]
    fn chance_is_no_alignment() {
        assert!(align_pairs(&pairs(&Sim3::identity(), true, 5), &PINHOLE, false).is_none());
        assert!(align_pairs(&pairs(&Sim3::identity(), true, 0)[..5], &PINHOLE, true).is_none());
    }

    proptest! {
        #[test]
        fn jacobians_are_the_numerical_derivatives(tau in prop::array::uniform7(-0.2f64..0.2), index in 0usize..120) {
            let pair = pairs(&Sim3::identity(), true, 0)[index];
            let a_from_b = sim3::exp(&Vector7::from(tau));
            let at = |s: &Sim3| pair.linearise(&PINHOLE, s, &[InlierClass::Full; 2]).map(Option::unwrap);
            let analytic = at(&a_from_b);
            for k in 0..7 {
                let mut step = Vector7::zeros();
                step[k] = 1e-6;
                let (up, down) = (at(&(sim3::exp(&step) * a_from_b)), at(&(sim3::exp(&-step) * a_from_b)));
                for side in 0..2 {
                    let numeric = (up[side].0 - down[side].0) / 2e-6;
                    prop_assert!((numeric - analytic[side].1.column(k)).norm() < 1e-5 * (1.0 + analytic[side].1.norm()));
                }
            }
        }
    }
}
