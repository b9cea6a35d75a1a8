//! The tracker's solvers for one view and for two: pose from known points, relative pose from matches, triangulation.
//!
//! An answer's error is weighed by what the measurements tell at the truth (their information, by central differences): 1 is what noise
//! explains. An answer that was refused is no failure; one that was given must be right.

use fastrand::Rng;
use nalgebra::{DVector, Matrix3, Point3, Vector2, Vector3};

use super::geometry::{
    PINHOLE, PIXEL_SIGMA, VOLUME, WORLDS, World, condition, information, is_finite, noise, pose_error, sigmas, small_motion,
    step, world_point,
};
use super::{Family, Outcome, Part};
use crate::geometry::{Se3, se3};
use crate::tracking::initialisation::two_view::two_views;
use crate::tracking::map::triangulation::{View, triangulate};
use crate::tracking::solvers::pose::{PoseObservation, optimise_pose};

/// Errors beyond this many standard deviations are not the noise's.
const SIGMAS: f64 = 6.0;
/// Fewer inliers than this are no pose to the tracker.
const FEWEST: usize = 20;
/// A relative pose that bundle adjustment mends: its axis and direction off by no more, degrees.
const TURN_LIMIT_DEG: f64 = 2.0;
const DIRECTION_LIMIT_DEG: f64 = 15.0;
/// Points at a smaller angle than this are not taken by the tracker, see `triangulate.rs`.
const MAX_PARALLAX_COSINE: f64 = 0.9998;

pub fn families() -> Vec<Family<'static>> {
    let poses = WORLDS.into_iter().flat_map(|(name, world)| {
        [(false, ""), (true, ", depth")].map(|(with_depth, more)| {
            Family::new(Part::Tracker, format!("pose: {name}{more}"), 1, move |rng| Ok(pose(rng, &world, with_depth, 0.0)))
        })
    });
    let outliers = Family::new(Part::Tracker, "pose: 30% outliers", 1, |rng| Ok(pose(rng, &VOLUME, false, 0.3)));
    let two = MOTIONS.into_iter().map(|(name, motion)| {
        Family::new(Part::Tracker, format!("two views: {name}"), 2, move |rng| Ok(two_view_case(rng, &motion)))
    });
    let met = PARALLAXES.into_iter().flat_map(|degrees| {
        [("", 1.0, 0.0), (", 10 km away", 1.0, 1e4), (", size 1e-3", 1e-3, 0.0), (", size 1e3", 1e3, 0.0)].map(
            |(name, scale, away)| {
                let world = World { scale, away, ..VOLUME };
                let case = move |rng: &mut Rng| Ok(triangulation(rng, &world, degrees));
                Family::new(Part::Tracker, format!("triangulation: {degrees}°{name}"), 1, case)
            },
        )
    });
    poses.chain([outliers]).chain(two).chain(met).collect()
}

fn pose(rng: &mut Rng, world: &World, with_depth: bool, outliers: f64) -> Outcome {
    let world_from_home = world.placed(rng);
    let camera_from_home = small_motion(rng, 0.5, 0.3);
    let truth = world.camera(&camera_from_home, &world_from_home);
    let (mut observations, mut good) = (Vec::new(), Vec::new());
    while observations.len() < 150 {
        let p_in_camera = world.point(rng);
        let Some(mut measurement) = world.measure(rng, &(p_in_camera * world.scale), with_depth) else { continue };
        let is_good = rng.f64() >= outliers;
        if !is_good {
            measurement.pixel = Vector2::new(640.0 * rng.f64(), 480.0 * rng.f64());
        }
        let point_in_world = world_point(&world_from_home, &camera_from_home, &p_in_camera);
        observations.push(PoseObservation { point_in_world, measurement });
        good.push(is_good);
    }
    let residuals = |by: &DVector<f64>| {
        let pose = step(&truth, by, world.scale);
        let of = |(o, _): (&PoseObservation, _)| o.measurement.residual(&PINHOLE, &(pose * o.point_in_world).coords);
        let all = observations.iter().zip(&good).filter(|(_, good)| **good).filter_map(of);
        DVector::from_iterator(
            3 * good.len(),
            all.flat_map(|r| [r.x, r.y, r.z]).chain(std::iter::repeat(0.0)).take(3 * good.len()),
        )
    };
    let information = information(residuals, 6);
    let initial = step(&truth, &pose_error(&small_motion(rng, 0.05 * world.near, 0.03), &Se3::identity(), 1.0), world.scale);
    let found = optimise_pose(&PINHOLE, &initial, None, &observations);
    let mut outcome = Outcome::default();
    if found.inliers < FEWEST {
        outcome.count("refused", 1);
        return outcome;
    }
    let error = pose_error(&found.camera_from_world, &truth, world.scale);
    outcome.require(is_finite(&found.camera_from_world), || "the pose is not finite".into());
    outcome.note("condition, log10", condition(&information));
    outcome.note("rotation, rad", error.rows(3, 3).norm());
    outcome.note("translation, of the depth", error.rows(0, 3).norm() / world.near);
    outcome.measure("error, sigmas", sigmas(&error, &information), SIGMAS);
    outcome
}

/// A motion between two views, and what is seen.
#[derive(Clone, Copy, Debug)]
struct Motion {
    world: World,
    /// Length of the translation, and the most that each axis turns.
    metres: f64,
    rad: f64,
    outliers: f64,
    /// Along the line of sight.
    forward: bool,
}

const WALK: Motion = Motion { world: VOLUME, metres: 0.3, rad: 0.1, outliers: 0.1, forward: false };

const MOTIONS: [(&str, Motion); 12] = [
    ("volume", WALK),
    ("plane", Motion { world: super::geometry::PLANE, ..WALK }),
    ("forward", Motion { forward: true, ..WALK }),
    ("40% outliers", Motion { outliers: 0.4, ..WALK }),
    ("baseline 0.03", Motion { metres: 0.03, ..WALK }),
    ("baseline 0.003", Motion { metres: 0.003, ..WALK }),
    ("baseline 0.0003", Motion { metres: 0.0003, ..WALK }),
    ("far points", Motion { world: World { near: 50.0, far: 200.0, ..VOLUME }, ..WALK }),
    ("mere turn", Motion { metres: 0.0, ..WALK }),
    ("mere turn, 40% outliers", Motion { metres: 0.0, outliers: 0.4, ..WALK }),
    ("nothing moved", Motion { metres: 0.0, rad: 0.0, outliers: 0.0, ..WALK }),
    ("chance", Motion { outliers: 1.0, ..WALK }),
];

fn two_view_case(rng: &mut Rng, motion: &Motion) -> Outcome {
    let turn = small_motion(rng, 0.0, motion.rad).rotation;
    let direction = Vector3::from_fn(|_, _| 2.0 * rng.f64() - 1.0);
    let direction = if motion.forward { Vector3::z() } else { direction.normalize() };
    let truth = Se3::from_parts((direction * motion.metres).into(), turn);
    let (mut matches, mut good) = (Vec::new(), Vec::new());
    while matches.len() < 300 {
        let p = Point3::from(motion.world.point(rng));
        let (Some(first), Some(second)) = (PINHOLE.project(&p.coords), PINHOLE.project(&(truth * p).coords)) else { continue };
        let is_good = rng.f64() >= motion.outliers;
        let wrong = Vector2::new(640.0 * rng.f64(), 480.0 * rng.f64());
        matches.push((first + noise(rng), if is_good { second + noise(rng) } else { wrong }));
        good.push(is_good);
    }
    let mut outcome = Outcome::default();
    let Some(found) = two_views(&matches, &PINHOLE) else {
        outcome.count("refused", 1);
        return outcome;
    };
    let may_be_found = motion.metres > 0.0 && motion.outliers < 1.0;
    outcome.require(may_be_found, || "a motion was made up where there is none".into());
    outcome.require(is_finite(&found.second_from_first), || "the motion is not finite".into());
    if may_be_found {
        let found = found.second_from_first;
        let turn_deg = found.rotation.angle_to(&truth.rotation).to_degrees();
        let cosine = found.translation.vector.normalize().dot(&direction);
        outcome.measure("turn, degrees", turn_deg, TURN_LIMIT_DEG);
        outcome.measure("direction, degrees", cosine.clamp(-1.0, 1.0).acos().to_degrees(), DIRECTION_LIMIT_DEG);
        outcome.note("error, sigmas", two_view_sigmas(&found, &truth, &matches, &good));
    }
    outcome
}

/// The error of a relative pose in standard deviations, by the matches' distances from their epipolar lines (Sampson).
fn two_view_sigmas(found: &Se3, truth: &Se3, matches: &[(Vector2<f64>, Vector2<f64>)], good: &[bool]) -> f64 {
    let k =
        Matrix3::new(PINHOLE.fx, 0.0, PINHOLE.cx, 0.0, PINHOLE.fy, PINHOLE.cy, 0.0, 0.0, 1.0).try_inverse().unwrap_or_default();
    let direction = truth.translation.vector.normalize();
    let across = direction.cross(&if direction.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() }).normalize();
    let along = [across, direction.cross(&across)];
    let residuals = |by: &DVector<f64>| {
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(by[0], by[1], by[2])) * truth.rotation;
        let towards = (direction + along[0] * by[3] + along[1] * by[4]).normalize();
        let f = k.transpose() * se3::skew(&towards) * turn.to_rotation_matrix().matrix() * k;
        let sampson = |((a, b), good): (&(Vector2<f64>, Vector2<f64>), &bool)| {
            let (there, back) = (f * a.push(1.0), f.transpose() * b.push(1.0));
            let distance = b.push(1.0).dot(&there) / (there.xy().norm_squared() + back.xy().norm_squared()).sqrt();
            if *good { distance / PIXEL_SIGMA } else { 0.0 }
        };
        DVector::from_iterator(matches.len(), matches.iter().zip(good).map(sampson))
    };
    let turn = (found.rotation * truth.rotation.inverse()).scaled_axis();
    let towards = found.translation.vector.normalize();
    let error = DVector::from_column_slice(&[turn.x, turn.y, turn.z, towards.dot(&along[0]), towards.dot(&along[1])]);
    sigmas(&error, &information(residuals, 5))
}

/// Angles at which two lines of sight meet.
const PARALLAXES: [f64; 4] = [20.0, 2.0, 0.2, 0.002];

fn triangulation(rng: &mut Rng, world: &World, degrees: f64) -> Outcome {
    let world_from_home = world.placed(rng);
    let p_at_home = Point3::from(world.point(rng));
    // The second camera looks at the point from a place turned about it.
    let axis = nalgebra::Unit::new_normalize(Vector3::new(rng.f64() - 0.5, 1.0, 0.0));
    let about = nalgebra::UnitQuaternion::from_axis_angle(&axis, degrees.to_radians());
    let second_from_home = Se3::from_parts((p_at_home.coords - about * p_at_home.coords).into(), about);
    let poses = [Se3::identity(), second_from_home].map(|pose| world.camera(&pose, &world_from_home));
    let truth = world_from_home.act(&p_at_home);
    let seen = poses.map(|pose| PINHOLE.project(&((pose * truth).coords / world.scale)));
    let ([Some(first), Some(second)], mut outcome) = (seen, Outcome::default()) else { return Outcome::default() };
    let measured = [first + noise(rng), second + noise(rng)];
    let [a, b] = [0, 1].map(|i| View { camera_from_world: &poses[i], pinhole: &PINHOLE });
    let met = triangulate(&a, &measured[0], &b, &measured[1]).filter(|met| met.parallax_cosine < MAX_PARALLAX_COSINE);
    let Some(met) = met else {
        outcome.count("refused", 1);
        return outcome;
    };
    let residuals = |by: &DVector<f64>| {
        let point = truth + Vector3::new(by[0], by[1], by[2]) * world.scale;
        let pixels = poses.map(|pose| PINHOLE.project(&((pose * point).coords / world.scale)).unwrap_or_default() / PIXEL_SIGMA);
        DVector::from_iterator(4, pixels.iter().flat_map(|p| [p.x, p.y]))
    };
    let information = information(residuals, 3);
    let error = (met.point - truth) / world.scale;
    outcome.require(met.point.coords.iter().all(|v| v.is_finite()), || "the point is not finite".into());
    outcome.note("condition, log10", condition(&information));
    outcome.note("error, of the depth", error.norm() / p_at_home.z);
    outcome.measure("error, sigmas", sigmas(&DVector::from_column_slice(error.as_slice()), &information), SIGMAS);
    outcome
}
