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
    let (before, after) = problem.solve(&PINHOLE, 30, CONVERGED);
    assert!(before > 1e4 && after < 1e-6, "{before} → {after}");
    assert!(worst_pose_error(&problem, &truth) < 1e-5);
    let points = problem.points.iter().zip(&truth.points).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(points < 1e-4, "{points}");
}

#[test]
fn outliers_are_found_and_do_not_pull() {
    let (mut problem, truth) = scene(0.5, true);
    let start = worst_pose_error(&problem, &truth);
    problem.solve(&PINHOLE, 10, CONVERGED);
    problem.classify(&PINHOLE);
    problem.solve(&PINHOLE, 10, CONVERGED);
    let end = worst_pose_error(&problem, &truth);
    assert!(start > 0.02 && end < 0.003, "{start} → {end}");
    for o in &problem.observations {
        if (o.point + o.pose) % 15 == 0 {
            assert_eq!(o.class, InlierClass::Outlier);
        }
    }
}

#[test]
fn measured_relative_poses_hold_cameras_without_points() {
    let (mut problem, truth) = scene(0.0, false);
    (problem.points, problem.observations) = (Vec::new(), Vec::new());
    for (current, reference) in [(0, 4), (1, 0), (1, 2), (3, 2), (5, 3), (0, 3)] {
        let current_from_reference = truth.poses[current] * truth.poses[reference].inverse();
        let information = Matrix6::identity() * 1e4;
        problem.relative_poses.push(RelativePose { current, reference, current_from_reference, information });
    }
    let before = worst_pose_error(&problem, &truth);
    problem.solve(&PINHOLE, 30, CONVERGED);
    let after = worst_pose_error(&problem, &truth);
    assert!(before > 0.02 && after < 1e-6, "{before} → {after}");
}

#[test]
fn wrong_depths_hardly_pull() {
    let (mut problem, truth) = scene(0.0, false);
    for o in problem.observations.iter_mut().filter(|o| o.point % 7 == 0) {
        // Three standard deviations.
        o.measurement.inverse_depth = o.measurement.inverse_depth.map(|measured| measured - 0.03);
    }
    problem.solve(&PINHOLE, 50, CONVERGED);
    let error = worst_pose_error(&problem, &truth);
    assert!(error < 1e-3, "{error}");
}

#[test]
fn a_bias_of_the_depth_is_found() {
    let (mut problem, truth) = scene(0.0, false);
    let bias = DepthBias(Vector3::new(-0.004, 0.012, 0.02));
    for o in &mut problem.observations {
        let error = bias.at(&PINHOLE, &o.measurement.pixel);
        o.measurement.inverse_depth = o.measurement.inverse_depth.map(|measured| measured + error);
    }
    let mut unaware = problem.clone();
    problem.bias_prior = Some(BiasPrior { mean: DepthBias::default(), information: Vector3::repeat(1e-3) });
    problem.solve(&PINHOLE, 50, CONVERGED);
    unaware.solve(&PINHOLE, 50, CONVERGED);
    assert!((problem.depth_bias.0 - bias.0).norm() < 1e-5, "{:?}", problem.depth_bias);
    assert_eq!(unaware.depth_bias, DepthBias::default());
    let (error, without) = (worst_pose_error(&problem, &truth), worst_pose_error(&unaware, &truth));
    assert!(error < 1e-5 && without > 1e-3, "{error} {without}");
    // A prior that is certain keeps it.
    problem.bias_prior = Some(BiasPrior { mean: DepthBias::default(), information: Vector3::repeat(1e15) });
    problem.solve(&PINHOLE, 50, CONVERGED);
    assert!(problem.depth_bias.0.norm() < 1e-6, "{:?}", problem.depth_bias);
}

#[test]
fn the_offset_of_a_pairs_disparities_is_found_and_no_tilt() {
    const SCALE: f64 = 50.0;
    let (mut problem, truth) = scene(0.5, false);
    let offset = 0.1 / SCALE;
    for o in &mut problem.observations {
        o.measurement.inverse_depth = o.measurement.inverse_depth.map(|measured| measured + offset);
    }
    let mut unaware = problem.clone();
    problem.bias_prior = Some(BiasPrior::of_pair(SCALE));
    problem.solve(&PINHOLE, 50, CONVERGED);
    unaware.solve(&PINHOLE, 50, CONVERGED);
    let found = problem.depth_bias.0;
    // The prior holds it back: these are a few dozen points.
    assert!(found.x > 0.3 * offset && found.x < offset && found.yz().norm() < 1e-2 * offset, "{found}");
    let (error, without) = (worst_pose_error(&problem, &truth), worst_pose_error(&unaware, &truth));
    assert!(error < 0.9 * without, "{error} {without}");
}

#[test]
fn the_gradient_by_the_bias_is_the_numerical_derivative_of_the_cost() {
    let (mut problem, _) = scene(0.5, false);
    problem.depth_bias = DepthBias(Vector3::new(0.002, -0.005, 0.004));
    problem.bias_prior = Some(BiasPrior::after(&DepthBias(Vector3::new(0.001, 0.002, 0.003)), 0.02));
    let gradient = problem.linearise(&PINHOLE).gradient_blocks[problem.free_poses];
    for k in 0..3 {
        const STEP: f64 = 1e-6;
        let cost = |sign: f64| {
            let mut moved = problem.clone();
            moved.depth_bias.0[k] += sign * STEP;
            moved.cost(&PINHOLE)
        };
        let numeric = (cost(1.0) - cost(-1.0)) / (2.0 * STEP);
        // The gradient leaves out the factor of two.
        assert!((numeric - 2.0 * gradient[k]).abs() < 1e-4 * (1.0 + numeric.abs()), "{k}: {numeric} {}", gradient[k]);
    }
}

#[test]
fn the_reduced_system_steps_as_the_full_one_does() {
    for bias_prior in [None, Some(BiasPrior::after(&DepthBias(Vector3::new(0.001, -0.002, 0.003)), 0.02))] {
        compare_with_the_full_system(bias_prior);
    }
}

fn compare_with_the_full_system(bias_prior: Option<BiasPrior>) {
    let (problem, _) = scene(0.5, false);
    let (points, observations) = (problem.points[..8].to_vec(), problem.observations[..48].to_vec());
    let problem = BundleProblem { points, observations, bias_prior, ..problem };
    let system = problem.linearise(&PINHOLE);
    let (lambda, blocks) = (1e-3, problem.blocks());
    let (poses, size) = (6 * blocks, 6 * blocks + 24);
    let (mut full, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
    for k in 0..blocks {
        full.fixed_view_mut::<6, 6>(6 * k, 6 * k).copy_from(&system.hessian_blocks[k]);
        right.fixed_rows_mut::<6>(6 * k).copy_from(&-system.gradient_blocks[k]);
    }
    for (k, coupling) in system.bias_by_pose.iter().enumerate().filter(|_| bias_prior.is_some()) {
        full.fixed_view_mut::<6, 6>(24, 6 * k).copy_from(coupling);
        full.fixed_view_mut::<6, 6>(6 * k, 24).copy_from(&coupling.transpose());
    }
    for k in 0..8 {
        full.fixed_view_mut::<3, 3>(poses + 3 * k, poses + 3 * k).copy_from(&system.hessian_points[k]);
        right.fixed_rows_mut::<3>(poses + 3 * k).copy_from(&-system.gradient_points[k]);
    }
    for m in &system.mixed {
        full.fixed_view_mut::<6, 3>(6 * m.block, poses + 3 * m.point).copy_from(&m.block_by_point);
        full.fixed_view_mut::<3, 6>(poses + 3 * m.point, 6 * m.block).copy_from(&m.block_by_point.transpose());
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
    if bias_prior.is_some() {
        assert!((stepped.depth_bias.0 - expected.fixed_rows::<3>(24)).norm() < 1e-8);
    }
    for k in 0..8 {
        assert!((stepped.points[k] - problem.points[k] - expected.rows(poses + 3 * k, 3)).norm() < 1e-8);
    }
}
