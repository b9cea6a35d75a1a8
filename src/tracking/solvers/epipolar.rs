//! The relative pose of two views by least squares on their matches' distances from the epipolar lines.
//!
//! What RANSAC finds fits five matches exactly and all others by chance: nine standard deviations off in the median (`docs/stress.md`). Here the pose is refined over
//! all inliers (Hartley & Zisserman, *Multiple View Geometry*, 2nd ed., sec. 11.4.3: Sampson's distance; Levenberg-Marquardt, Huber weights).

use nalgebra::{Matrix2x3, Matrix3, Matrix5, Translation3, UnitQuaternion, Vector2, Vector3, Vector5};

use crate::geometry::se3::skew;
use crate::geometry::{Pinhole, Se3};
use crate::tracking::solvers::residual::huber;

/// Distance from which on a match pulls less and less, pixels.
const HUBER_PIXELS: f64 = 1.0;
const MAX_ROUNDS: usize = 30;
/// Steps shorter than this change nothing, radians.
const SHORT: f64 = 1e-9;

/// F of b·F·a = 0, for pixels a of the first view and b of the second.
pub fn fundamental(second_from_first: &Se3, pinhole: &Pinhole) -> Matrix3<f64> {
    let rotation = *second_from_first.rotation.to_rotation_matrix().matrix();
    fundamental_of(&(skew(&second_from_first.translation.vector) * rotation), pinhole)
}

/// Fundamental matrix of an essential matrix.
pub fn fundamental_of(essential: &Matrix3<f64>, pinhole: &Pinhole) -> Matrix3<f64> {
    let Pinhole { fx, fy, cx, cy, .. } = *pinhole;
    let inverse = Matrix3::new(1.0 / fx, 0.0, -cx / fx, 0.0, 1.0 / fy, -cy / fy, 0.0, 0.0, 1.0);
    inverse.transpose() * essential * inverse
}

/// The motion, its translation of length 1, that fits these matched pixels best from `second_from_first` on. With nothing to go by, that.
pub fn refine<'a>(
    second_from_first: &Se3,
    matches: impl Iterator<Item = &'a (Vector2<f64>, Vector2<f64>)> + Clone,
    pinhole: &Pinhole,
) -> Se3 {
    let mut pose = *second_from_first;
    let mut system = System::new(&pose, matches.clone(), pinhole);
    let mut damping = 1e-4;
    for _ in 0..MAX_ROUNDS {
        let damped = system.hessian + Matrix5::from_diagonal(&system.hessian.diagonal()) * damping;
        let Some(step) = damped.cholesky().map(|factors| -factors.solve(&system.gradient)) else { break };
        let candidate = moved(&pose, &step);
        let next = System::new(&candidate, matches.clone(), pinhole);
        // NaN is no gain.
        if next.cost < system.cost {
            (pose, system, damping) = (candidate, next, damping * 0.1);
        } else {
            damping *= 10.0;
        }
        if step.norm() < SHORT {
            break;
        }
    }
    pose
}

/// Two directions across the translation, as rows.
fn across(direction: &Vector3<f64>) -> Matrix2x3<f64> {
    let axis = if direction.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let one = direction.cross(&axis).normalize();
    Matrix2x3::from_rows(&[one.transpose(), direction.cross(&one).transpose()])
}

/// Turned by the first three, and the direction moved across itself by the last two.
fn moved(pose: &Se3, by: &Vector5<f64>) -> Se3 {
    let direction = pose.translation.vector;
    let turn = UnitQuaternion::from_scaled_axis(by.fixed_rows::<3>(0).into_owned());
    let towards = direction + across(&direction).transpose() * by.fixed_rows::<2>(3);
    Se3::from_parts(Translation3::from(towards.normalize()), turn * pose.rotation)
}

/// Normal equations at a pose.
struct System {
    hessian: Matrix5<f64>,
    gradient: Vector5<f64>,
    cost: f64,
}

impl System {
    fn new<'a>(pose: &Se3, matches: impl Iterator<Item = &'a (Vector2<f64>, Vector2<f64>)>, pinhole: &Pinhole) -> Self {
        let rotation = *pose.rotation.to_rotation_matrix().matrix();
        let translation = pose.translation.vector;
        let f = fundamental(pose, pinhole);
        let sides = across(&translation);
        let by: [Matrix3<f64>; 5] = std::array::from_fn(|k| {
            let essential = match k {
                0..3 => skew(&translation) * skew(&Vector3::ith(k, 1.0)) * rotation,
                _ => skew(&sides.row(k - 3).transpose()) * rotation,
            };
            fundamental_of(&essential, pinhole)
        });
        let mut system = Self { hessian: Matrix5::zeros(), gradient: Vector5::zeros(), cost: 0.0 };
        for (a, b) in matches {
            let (a, b) = (a.push(1.0), b.push(1.0));
            let (line_b, line_a) = ((f * a).xy(), (f.transpose() * b).xy());
            let length = (line_a.norm_squared() + line_b.norm_squared()).sqrt().max(1e-300);
            let distance = b.dot(&(f * a)) / length;
            let jacobian = Vector5::from_fn(|k, _| {
                let (there, back) = (by[k] * a, by[k].transpose() * b);
                let length_by = (line_b.dot(&there.xy()) + line_a.dot(&back.xy())) / length;
                (b.dot(&there) - distance * length_by) / length
            });
            let (cost, weight) = huber(distance * distance, HUBER_PIXELS * HUBER_PIXELS);
            system.hessian += weight * jacobian * jacobian.transpose();
            system.gradient += weight * distance * jacobian;
            system.cost += cost;
        }
        system
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::{Point3, Vector6};

    /// Matches of a volume, up to `noise` pixels off.
    fn matches(truth: &Se3, noise: f64) -> Vec<(Vector2<f64>, Vector2<f64>)> {
        let mut random = fastrand::Rng::with_seed(7);
        let mut found = Vec::new();
        while found.len() < 300 {
            let pixel = Vector2::new(640.0 * random.f64(), 480.0 * random.f64());
            let p = Point3::from(PINHOLE.unproject(&pixel, 2.0 + 3.0 * random.f64()));
            let off = Vector2::new(random.f64() - 0.5, random.f64() - 0.5) * 2.0 * noise;
            found.extend(PINHOLE.project(&(truth * p).coords).map(|seen| (pixel, seen + off)));
        }
        found
    }

    fn truth() -> Se3 {
        let mut truth = se3::exp(&Vector6::new(0.5, -0.1, 0.1, 0.02, -0.1, 0.03));
        truth.translation.vector.normalize_mut();
        truth
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let all = matches(&truth(), 0.3);
        let pose = moved(&truth(), &Vector5::new(0.002, -0.001, 0.001, 0.004, -0.003));
        let system = System::new(&pose, all.iter(), &PINHOLE);
        for k in 0..5 {
            let cost = |by: f64| System::new(&moved(&pose, &Vector5::ith(k, by)), all.iter(), &PINHOLE).cost;
            // The cost is a sum of squares, not of their halves.
            let slope = (cost(1e-6) - cost(-1e-6)) / 4e-6;
            assert!((slope - system.gradient[k]).abs() < 1e-5 * system.gradient.norm(), "{k}: {slope} {}", system.gradient[k]);
        }
    }

    #[test]
    fn a_rough_pose_becomes_what_the_matches_tell() {
        let rough = moved(&truth(), &Vector5::new(0.01, -0.02, 0.01, 0.2, -0.1));
        for (noise, limit) in [(0.0, 1e-8), (0.5, 0.02)] {
            let found = refine(&rough, matches(&truth(), noise).iter(), &PINHOLE);
            let (turn, towards) = (found.rotation.angle_to(&truth().rotation), found.translation.vector);
            assert!(turn < limit && towards.angle(&truth().translation.vector) < limit, "{noise}: {turn} {towards}");
        }
    }

    #[test]
    fn nothing_to_go_by_changes_nothing() {
        assert_eq!(refine(&truth(), [].iter(), &PINHOLE), truth());
        let nonsense = [(Vector2::repeat(f64::NAN), Vector2::repeat(0.0)); 9];
        assert_eq!(refine(&truth(), nonsense.iter(), &PINHOLE), truth());
    }
}
