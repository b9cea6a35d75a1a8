//! Bundle adjustment on made-up scenes: against the truth, and against the full equations.

use nalgebra::{DMatrix, DVector, Vector2};

use super::*;
use crate::tracking::solvers::residual::tests::PINHOLE;

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
            let class = if inverse_depth.is_some() { InlierClass::Full } else { InlierClass::PixelOnly };
            truth.observations.push(BundleObservation { pose, point, measurement, class });
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
    problem.classify(&PINHOLE);
    problem.solve(&PINHOLE, 10);
    let end = worst_pose_error(&problem, &truth);
    assert!(start > 0.02 && end < 0.003, "{start} → {end}");
    for o in &problem.observations {
        if (o.point + o.pose) % 15 == 0 {
            assert_eq!(o.class, InlierClass::Outlier);
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
    let reduced = problem.reduced_system().unwrap();
    assert!(stepped.step(&system, &reduced, lambda));
    for k in 0..4 {
        let step = se3::log(&(stepped.poses[k] * problem.poses[k].inverse()));
        assert!((step - expected.rows(6 * k, 6)).norm() < 1e-8);
    }
    for k in 0..8 {
        assert!((stepped.points[k] - problem.points[k] - expected.rows(poses + 3 * k, 3)).norm() < 1e-8);
    }
}
