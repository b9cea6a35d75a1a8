use super::*;

const HEIGHT: f64 = 480.0;
/// Poses between two frames.
const A_FRAME: f64 = 0.1;

/// Cameras with a rolling shutter on an arc around a box of points, and what they measure.
fn problem(noise: f64, seed: u64) -> (LensProblem, Lens) {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut uniform = |low: f64, high: f64| low + (high - low) * random.f64();
    let lens =
        Lens { focal: 520.0, distortion: Distortion { k1: -0.08, k2: 0.03, p1: 0.002, p2: -0.001, k3: 0.0 }, readout: 0.6 };
    let points: Vec<Point3<f64>> =
        (0..300).map(|_| Point3::new(uniform(-1.5, 1.5), uniform(-1.2, 1.2), uniform(2.0, 4.5))).collect();
    let pose = |k: f64| {
        let t = k / 11.0;
        se3::exp(&Vector6::new(0.8 * t, 0.1 * (7.0 * t).sin(), 0.2 * t, 0.1 * t, -0.35 * t, 0.1 * (5.0 * t).cos()))
    };
    let poses: Vec<Se3> = (0..12).map(|k| pose(k.into())).collect();
    let motion = |k: i32| se3::log(&(pose(f64::from(k) + A_FRAME) * pose(k.into()).inverse()));
    let mut observations = Vec::new();
    for (point, position) in points.iter().enumerate() {
        for k in 0..poses.len() {
            // The row that shows the point when it is read.
            let seen_at = |row: f64| lens.project(&(pose(k as f64 + A_FRAME * lens.readout * row) * position).coords);
            let pixel = (0..4).fold(seen_at(0.0), |pixel, _| seen_at(pixel.y / HEIGHT));
            let pixel = pixel + Vector2::new(uniform(-noise, noise), uniform(-noise, noise));
            observations.push(PixelObservation { pose: k, point, pixel, weight: 1.0 });
        }
    }
    let motions = (0..12).map(motion).collect();
    (LensProblem { lens, poses, motions, height: HEIGHT, points, observations }, lens)
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
        for term in 0..TERMS {
            let mut unit = SVector::<f64, TERMS>::zeros();
            unit[term] = 1.0;
            let moved = numeric(&|p, h| p.lens = p.lens.stepped(&(unit * h)));
            assert!((moved - l.by_lens.column(term)).norm() < 1e-4);
        }
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
    for (noise, tolerance, seed) in [(0.0, 1e-3, 1), (1.0, 0.02, 2), (1.0, 0.02, 3), (1.0, 0.02, 4), (1.0, 0.02, 5)] {
        let (mut problem, truth) = problem(noise, seed);
        problem.lens = Lens { focal: 450.0, distortion: Distortion::default(), readout: 0.0 };
        // A wrong pixel or two.
        problem.observations.iter_mut().step_by(150).for_each(|o| o.pixel.x += 60.0);
        problem.solve(40);
        problem.drop_outliers();
        problem.solve(40);
        let deviation = problem.deviation(40).unwrap();
        let error = (problem.lens.focal / truth.focal - 1.0).abs();
        assert!(error < tolerance && error <= 4.0 * deviation.focal + 1e-5, "{:?} {deviation:?}", problem.lens);
        assert!((problem.lens.readout - truth.readout).abs() < 0.05 + 0.2 * noise, "{:?}", problem.lens);
        assert!((problem.lens.distortion.k1 - truth.distortion.k1).abs() < 4.0 * deviation.k1 + 1e-4 && deviation.focal < 0.02);
    }
}

#[test]
fn what_one_stretch_of_views_shows_otherwise_is_part_of_the_deviation() {
    let (mut problem, _) = problem(0.5, 6);
    problem.observations.iter_mut().filter(|o| o.pose < 3).for_each(|o| o.pixel *= 1.01);
    problem.solve(40);
    let (stated, whole) = (problem.deviation_by_residuals().unwrap(), problem.deviation(40).unwrap());
    assert!(whole.focal > 1.5 * stated.focal && whole.focal < 0.05, "{stated:?} {whole:?}");
}
