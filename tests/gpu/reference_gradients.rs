//! The oracle against central differences in f64: every parameter, the image loss. The smooth variant of the rasterizer is
//! used, since its cut-offs are discontinuities.

use fastrand::Rng;
use keysplat::splat::ShDegree;
use keysplat::splat::model::Surface;
use keysplat::verification::reference::loss::{LossWeights, Target64, loss};
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::rasterize_forward::render;
use keysplat::verification::reference::smoothing::{smooth, smooth_backward};
use keysplat::verification::reference::surface::{self, SurfaceWeights};
use keysplat::verification::reference::{Cutoffs, Gaussian64, Image64, View64, cloud64};
use nalgebra::Vector3;

const STEP: f64 = 1e-6;
const TOLERANCE: f64 = 1e-6;
/// Rounding of a loss of order 100, divided by the step.
const NOISE: f64 = 1e-7;

fn norm(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn difference(a: &[f64], b: &[f64]) -> f64 {
    norm(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>())
}

fn view(rng: &mut Rng) -> View64 {
    View64 {
        camera: crate::common::camera(rng, 12, 9),
        background: Vector3::new(0.2, 0.5, 0.1),
        cutoffs: Cutoffs::Smooth,
        antialiased: false,
        surface: Surface::Volume,
    }
}

/// Compares `gradient` with central differences of the loss by every number of every Gaussian.
fn check(cloud: &[Gaussian64], gradient: &[Gaussian64], loss: &dyn Fn(&[Gaussian64]) -> f64) {
    let mut compared = 0.0;
    for i in 0..cloud.len() {
        let derivative = |k: usize| {
            let shifted = |by: f64| {
                let mut moved = cloud.to_vec();
                let mut row = moved[i].flat();
                row[k] += by;
                moved[i] = Gaussian64::from_flat(&row);
                loss(&moved)
            };
            (shifted(STEP) - shifted(-STEP)) / (2.0 * STEP)
        };
        let numeric: Vec<f64> = (0..cloud[i].flat().len()).map(derivative).collect();
        let own = gradient[i].flat();
        assert!(difference(&own, &numeric) < TOLERANCE * norm(&own) + NOISE, "Gaussian {i}: {own:?} {numeric:?}");
        compared += norm(&own);
    }
    assert!(compared > 0.1, "the scene was hardly seen");
}

#[test]
fn parameter_gradients_are_central_differences() {
    for (seed, degree) in ShDegree::ALL.into_iter().enumerate() {
        let mut rng = Rng::with_seed(seed as u64);
        let view = view(&mut rng);
        let cloud = cloud64(&crate::common::scene(&mut rng, 6, degree));
        let by_image = crate::common::image_gradient(&mut rng, 12 * 9);
        let loss = |view: &View64, cloud: &[Gaussian64]| crate::common::linear_loss(&render(view, cloud), &by_image);
        check(&cloud, &backward(&view, &cloud, &by_image), &|cloud| loss(&view, cloud));

        let antialiased = View64 { antialiased: true, ..view };
        check(&cloud, &backward(&antialiased, &cloud, &by_image), &|cloud| loss(&antialiased, cloud));
        let planar = View64 { surface: Surface::Planar, ..view };
        check(&cloud, &backward(&planar, &cloud, &by_image), &|cloud| loss(&planar, cloud));
        let interval = |i: usize| 0.02 * i as f64;
        let smoothed = |cloud: &[Gaussian64]| cloud.iter().enumerate().map(|(i, g)| smooth(g, interval(i))).collect::<Vec<_>>();
        let by_smoothed = backward(&antialiased, &smoothed(&cloud), &by_image);
        let gradient = cloud.iter().zip(&by_smoothed).enumerate().map(|(i, (g, by))| smooth_backward(g, interval(i), by));
        check(&cloud, &gradient.collect::<Vec<_>>(), &|cloud| loss(&antialiased, &smoothed(cloud)));
    }
}

/// With Gaussians beyond the 15% margin the Jacobian is clamped, and its gradient with it.
#[test]
fn clamped_jacobians_have_the_right_gradient() {
    let mut rng = Rng::with_seed(7);
    let view = view(&mut rng);
    let mut cloud = cloud64(&crate::common::scene(&mut rng, 4, ShDegree::default()));
    for (i, g) in cloud.iter_mut().enumerate() {
        g.mean.x = if i % 2 == 0 { 1.2 } else { -1.3 } * g.mean.z;
        g.log_scale = Vector3::new(-0.8, -1.0, -0.9);
    }
    let by_image = crate::common::image_gradient(&mut rng, 12 * 9);
    let gradient = backward(&view, &cloud, &by_image);
    for i in 0..cloud.len() {
        for k in 0..3 {
            let shifted = |by: f64| {
                let mut moved = cloud.clone();
                moved[i].mean[k] += by;
                crate::common::linear_loss(&render(&view, &moved), &by_image)
            };
            let numeric = (shifted(STEP) - shifted(-STEP)) / (2.0 * STEP);
            let own = gradient[i].mean;
            assert!((own[k] - numeric).abs() < TOLERANCE * own.norm() + NOISE, "Gaussian {i}, axis {k}: {own} {numeric}");
        }
    }
}

#[test]
fn loss_gradient_is_a_central_difference() {
    let mut rng = Rng::with_seed(3);
    let (width, height) = (17, 14);
    let mut number = || rng.f64();
    let target = Target64 {
        width,
        height,
        color: (0..width * height).map(|_| Vector3::new(number(), number(), number())).collect(),
        depth: (0..width * height).map(|i| if i % 5 == 0 { 0.0 } else { 1.0 + number() }).collect(),
        valid: (0..width * height).map(|i| i % width > 3 || i % 11 == 0).collect(),
    };
    let image = Image64 {
        color: (0..width * height).map(|_| Vector3::new(number(), number(), number())).collect(),
        depth: (0..width * height).map(|_| 2.0 * number()).collect(),
        transmittance: (0..width * height).map(|_| 0.4 * number()).collect(),
        ..Image64::default()
    };
    let weights = LossWeights { ssim: 0.2, depth: 0.3, precise_depth: 1.5, phase: [1, 0] };
    let (_, gradient) = loss(&image, &target, &weights);
    let value = |change: &dyn Fn(&mut Image64)| {
        let mut moved = image.clone();
        change(&mut moved);
        loss(&moved, &target, &weights).0
    };
    for i in (0..width * height).step_by(7) {
        for c in 0..3 {
            let numeric = (value(&|m| m.color[i][c] += STEP) - value(&|m| m.color[i][c] -= STEP)) / (2.0 * STEP);
            assert!((gradient.color[i][c] - numeric).abs() < 1e-8, "pixel {i}, channel {c}");
        }
        let numeric = (value(&|m| m.depth[i] += STEP) - value(&|m| m.depth[i] -= STEP)) / (2.0 * STEP);
        assert!((gradient.depth[i] - numeric).abs() < 1e-8, "depth {i}");
        let numeric = (value(&|m| m.transmittance[i] -= STEP) - value(&|m| m.transmittance[i] += STEP)) / (2.0 * STEP);
        assert!((gradient.alpha[i] - numeric).abs() < 1e-8, "alpha {i}");
    }
}

/// The loss of a planar surface, with an edge, an opening and a slope of its own.
#[test]
fn surface_loss_gradient_is_a_central_difference() {
    let mut rng = Rng::with_seed(5);
    let pinhole = crate::common::camera(&mut rng, 15, 12).pinhole;
    let pixels = 15 * 12;
    let mut number = || rng.f64();
    let mut image = Image64::default();
    for i in 0..pixels {
        let (transmittance, depth) = (if i % 31 == 0 { 0.9 } else { 0.3 * number() }, if i % 15 < 6 { 1.0 } else { 1.3 });
        let sum = (1.0 - transmittance) * (depth + 0.01 * number());
        image.transmittance.push(transmittance);
        image.depth.push(sum);
        let slopes = Vector3::new(number() - 0.5, number() - 0.5, 0.0) * 0.02;
        image.surface.push(slopes + Vector3::new(0.0, 0.0, sum * sum / (1.0 - transmittance) * (1.0 + 0.1 * number())));
    }
    let weights = SurfaceWeights { normal: 2.0, spread: 3.0, min_alpha: 0.5, edge: 0.05 };
    let (value, gradient) = surface::loss(&pinhole, &image, &weights);
    let moved = |change: &dyn Fn(&mut Image64, f64)| {
        let at = |by: f64| {
            let mut moved = image.clone();
            change(&mut moved, by);
            surface::loss(&pinhole, &moved, &weights).0
        };
        (at(STEP) - at(-STEP)) / (2.0 * STEP)
    };
    assert!(value > 0.1 && gradient.surface.iter().filter(|by| by.x != 0.0).count() > pixels / 3, "most pixels have a normal");
    for i in 0..pixels {
        for c in 0..3 {
            let numeric = moved(&|m, by| m.surface[i][c] += by);
            assert!((gradient.surface[i][c] - numeric).abs() < 1e-7, "surface {i}, {c}: {} {numeric}", gradient.surface[i][c]);
        }
        let numeric = moved(&|m, by| m.depth[i] += by);
        assert!((gradient.depth[i] - numeric).abs() < 1e-7, "depth {i}: {} {numeric}", gradient.depth[i]);
        let numeric = moved(&|m, by| m.transmittance[i] -= by);
        assert!((gradient.alpha[i] - numeric).abs() < 1e-7, "alpha {i}: {} {numeric}", gradient.alpha[i]);
    }
}
