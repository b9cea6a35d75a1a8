//! The GPU against the f64 oracle: images, gradients by every parameter, the loss, Adam. Needs an adapter (the
//! software one will do); says so loudly and passes where there is none.

use crate::common::requirements::adapter;
use crate::oracle::*;
use fastrand::Rng;
use keysplat::optimise::{AdamConfig, LossConfig, Trainer, TrainingView, ssim_phase};
use keysplat::render::{GpuCloud, Rasterizer};
use keysplat::splat::model::{Dropout, Surface};
use keysplat::splat::{Exposure, GaussianCloud, ShDegree, opacity_from_raw, raw_opacity_from_opacity};
use keysplat::verification::reference::adam::{Adam64, Decay64};
use keysplat::verification::reference::loss::{LossWeights, loss};
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::{Gaussian64, View64, cloud64, rasterize_forward};
use nalgebra::Vector3;

#[test]
fn random_scenes_agree() {
    let Some(gpu) = adapter() else { return };
    for seed in 0..8 {
        let mut rng = Rng::with_seed(seed);
        let camera = crate::common::camera(&mut rng, 61, 45);
        let mut cloud = crate::common::scene(&mut rng, 300, ShDegree::ALL[(seed % 4) as usize]);
        compare(&gpu, &cloud, &camera, &mut rng);
        cloud.antialiased = true;
        // Of a pixel's size, and needles: what the compensation is for.
        (0..cloud.len()).for_each(|i| cloud.log_scales[i] -= glam::Vec3::new((i % 3) as f32, (i % 2) as f32, 1.0));
        compare(&gpu, &cloud, &camera, &mut rng);
    }
}
#[test]
fn the_loss_and_its_whole_gradient_agree() {
    let Some(gpu) = adapter() else { return };
    let config = LossConfig { ssim_weight: 0.2, depth_weight: 0.3, precise_depth_metres: 1.5 };
    // The numbers of steps have different phases.
    for (seed, steps) in [0, 1, 3, 4].into_iter().enumerate() {
        let mut rng = Rng::with_seed(40 + seed as u64);
        // Neither a multiple of the tile nor of the loss's block.
        let camera = crate::common::camera(&mut rng, 53, 37);
        let cloud = crate::common::scene(&mut rng, 200, ShDegree::ALL[seed]);
        let (image, wide) = target(&mut rng, camera.pinhole);
        let mut trainer = Trainer::new(gpu.clone()).unwrap();
        let on_gpu = upload(&gpu, &cloud);
        let image = upload_target(&gpu, &image, &wide);
        let still = AdamConfig::default().scaled(0.0, 0.0);
        let views = vec![TrainingView::new(camera, &image); steps];
        trainer.steps(&on_gpu, &views, &config, &still).unwrap();
        let got = trainer.gradients(&on_gpu, &camera, &image, &config).unwrap();
        let view = View64 { background: Vector3::zeros(), ..view64(&camera, &cloud, Surface::Volume) };
        let rendered = rasterize_forward::render(&view, &cloud64(&cloud));
        let weights = LossWeights {
            ssim: f64::from(config.ssim_weight),
            depth: f64::from(config.depth_weight),
            precise_depth: f64::from(config.precise_depth_metres),
            phase: ssim_phase(steps).map(|p| p as usize),
        };
        let (value, by_image) = loss(&rendered, &wide, &weights);
        let difference = (f64::from(got.loss.total(&config)) - value).abs();
        assert!(difference < 1e-4 * value, "loss {} against {value}", got.loss.total(&config));
        let expected = backward(&view, &cloud64(&cloud), &by_image);
        let error = crate::common::relative_error(&flat(&cloud64(&got.cloud)), &flat(&expected));
        assert!(error < GRADIENT_TOLERANCE, "gradient: {error:e}");
    }
}

/// Steps of the fused kernel, and what they average to, against the oracle's Adam fed with the GPU's own gradients.
#[test]
fn adam_steps_agree() {
    let Some(gpu) = adapter() else { return };
    let loss = LossConfig::default();
    let adam = AdamConfig {
        harmonics_every: 1,
        color_settling_steps: 2.0,
        geometry_settling_steps: 3.0,
        ema_steps: 1.5,
        harmonics_prior: 0.5,
        ..AdamConfig::default()
    };
    let mut rng = Rng::with_seed(11);
    let camera = crate::common::camera(&mut rng, 48, 32);
    let mut cloud = crate::common::scene(&mut rng, 60, ShDegree::ALL[1]);
    // One that cannot be seen: it must not move.
    cloud.means[5].z = -1.0;
    let (image, wide) = target(&mut rng, camera.pinhole);
    let image = upload_target(&gpu, &image, &wide);
    let mut trainer = Trainer::new(gpu.clone()).unwrap();
    let on_gpu = upload(&gpu, &cloud);
    let mut expected: Vec<Vec<f64>> = cloud64(&cloud).iter().map(Gaussian64::flat).collect();
    let mut states = vec![Adam64::default(); cloud.len()];
    for _ in 0..4 {
        let gradients = trainer.gradients(&on_gpu, &camera, &image, &loss).unwrap();
        for (i, gradient) in cloud64(&gradients.cloud).iter().enumerate() {
            let size = (expected[i][3..6].iter().sum::<f64>() / 3.0).exp();
            let pace = |settling: f64| (1.0 + f64::from(states[i].steps + 1) / settling).sqrt().recip();
            let mut rates = vec![f64::from(adam.lr_position) * size; 3];
            rates.extend([f64::from(adam.lr_log_scale); 3]);
            rates.extend([f64::from(adam.lr_rotation); 4]);
            rates.push(f64::from(adam.lr_opacity));
            rates.iter_mut().for_each(|rate| *rate *= pace(3.0));
            let pace = pace(2.0);
            rates.extend([f64::from(adam.lr_color) * pace; 3]);
            rates.extend([f64::from(adam.lr_harmonics) * pace; 9]);
            let decay = Decay64 { beta_1: adam.beta_1.into(), beta_2: adam.beta_2.into(), epsilon: adam.epsilon.into() };
            let before = states[i].steps;
            let mut gradient = gradient.flat();
            if gradient.iter().any(|g| *g != 0.0) {
                let prior = f64::from(adam.harmonics_prior) / f64::from(camera.pinhole.width * camera.pinhole.height);
                let harmonics = gradient.len() - 9;
                gradient[harmonics..].iter_mut().zip(&expected[i][harmonics..]).for_each(|(g, value)| *g += prior * value);
            }
            states[i].step(&mut expected[i], &gradient, &rates, decay);
            if states[i].steps > before {
                states[i].take_average(&expected[i], 1.0 / 1.5);
            }
        }
        let view = TrainingView::new(camera, &image);
        trainer.steps(&on_gpu, &[view], &loss, &adam).unwrap();
    }
    let moved = on_gpu.download(&gpu).unwrap();
    let start = flat(&cloud64(&cloud));
    let travel = |to: &[f64]| to.iter().zip(&start).map(|(a, b)| a - b).collect::<Vec<f64>>();
    let average = |(state, start): (&Adam64, Vec<f64>)| if state.steps > 0 { state.average.clone() } else { start };
    let averages: Vec<f64> = states.iter().zip(cloud64(&cloud).iter().map(Gaussian64::flat)).flat_map(average).collect();
    let error = crate::common::relative_error(&travel(&flat(&cloud64(&moved))), &travel(&averages));
    assert!(error < 1e-3, "Adam: {error:e}");
    assert_eq!(moved.get(5), cloud.get(5), "an unseen Gaussian moved");
}

/// The hazards of splatting, one Gaussian each, among ordinary ones: nothing may become NaN, and what is drawn must be right.
#[test]
fn hazards_stay_finite_and_right() {
    let Some(gpu) = adapter() else { return };
    type Spoil = fn(&mut GaussianCloud, usize);
    let hazards: &[(&str, Spoil)] = &[
        ("on the near plane", |c, i| c.means[i] = glam::Vec3::new(0.0, 0.0, 0.05)),
        ("just in front of the camera", |c, i| c.means[i] = glam::Vec3::new(0.02, 0.01, 0.3)),
        ("behind the camera", |c, i| c.means[i].z = -2.0),
        ("far beside the frustum", |c, i| c.means[i].x = 40.0),
        ("no rotation", |c, i| c.rotations[i] = glam::Quat::from_xyzw(0.0, 0.0, 0.0, 0.0)),
        ("tiny rotation", |c, i| c.rotations[i] *= 1e-3),
        ("huge", |c, i| c.log_scales[i] = glam::Vec3::splat(3.0)),
        ("overflowing scale", |c, i| c.log_scales[i] = glam::Vec3::splat(100.0)),
        ("vanishing scale", |c, i| c.log_scales[i] = glam::Vec3::splat(-40.0)),
        ("a needle", |c, i| c.log_scales[i] = glam::Vec3::new(0.0, -12.0, -12.0)),
        ("a disc", |c, i| c.log_scales[i] = glam::Vec3::new(-1.0, -1.0, -14.0)),
        ("opaque", |c, i| c.raw_opacities[i] = 30.0),
        ("transparent", |c, i| c.raw_opacities[i] = -30.0),
        ("at the cut-off", |c, i| c.raw_opacities[i] = -5.5373344),
        ("same depth as another", |c, i| c.means[i] = c.means[0]),
        ("out of gamut", |c, i| c.sh[i] = glam::Vec3::new(-9.0, 40.0, 0.0)),
    ];
    for (seed, (name, spoil)) in hazards.iter().enumerate() {
        let mut rng = Rng::with_seed(seed as u64);
        let camera = crate::common::camera(&mut rng, 40, 30);
        let mut cloud = crate::common::scene(&mut rng, 40, ShDegree::default());
        spoil(&mut cloud, 7);
        eprintln!("hazard: {name}");
        let expected = compare(&gpu, &cloud, &camera, &mut rng);
        assert!(expected.transmittance.iter().any(|t| *t < 0.9), "the scene was not seen");
        cloud.antialiased = true;
        compare(&gpu, &cloud, &camera, &mut rng);
    }
}

#[test]
fn non_finite_gaussians_are_refused_or_culled() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(1);
    let camera = crate::common::camera(&mut rng, 40, 30);
    let clean = crate::common::scene(&mut rng, 30, ShDegree::default());
    let mut dirty = clean.clone();
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut bad = clean.get(0);
        bad.mean.x = value;
        dirty.push(bad);
        let mut bad = clean.get(0);
        bad.raw_opacity = value;
        dirty.push(bad);
    }
    let mut on_gpu = GpuCloud::new(&gpu, dirty.sh_degree, 4).unwrap();
    assert_eq!(on_gpu.append(&gpu, &dirty).unwrap(), 6, "bad Gaussians are counted");
    let mut rasterizer = Rasterizer::new(gpu.clone()).unwrap();
    let rendered = rasterizer.render(&on_gpu, &camera, BACKGROUND).unwrap();
    // Even written straight into the buffer they are culled, not spread.
    on_gpu.parameters().write(&gpu, 3, &[[f32::NAN; 4]]);
    let with_nan = rasterizer.render(&on_gpu, &camera, BACKGROUND).unwrap();
    assert_eq!(rendered.transmittance.len(), with_nan.transmittance.len());
    assert!(with_nan.color_depth.iter().flatten().all(|v| v.is_finite()));
}

/// The step learns from the Gaussians that are left, with larger opacities, and moves no other.
#[test]
fn dropped_gaussians_take_no_part() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(12);
    let camera = crate::common::camera(&mut rng, 64, 48);
    let mut cloud = crate::common::scene(&mut rng, 400, ShDegree::default());
    cloud.raw_opacities.iter_mut().for_each(|raw| *raw = raw.min(0.0) - 0.5);
    let (image, wide) = target(&mut rng, camera.pinhole);
    let image = upload_target(&gpu, &image, &wide);
    let dropout = Dropout { share: 0.3, seed: 77 };
    let is_dropped = |i: u32| {
        let state = (i + dropout.seed).wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
        f64::from((word >> 22) ^ word) < 0.3 * f64::from(u32::MAX)
    };
    let mut rest = cloud.emptied();
    for i in (0..cloud.len()).filter(|i| !is_dropped(*i as u32)) {
        let mut gaussian = cloud.get(i);
        gaussian.raw_opacity = raw_opacity_from_opacity(opacity_from_raw(gaussian.raw_opacity) / 0.7);
        rest.push(gaussian);
    }
    let share = 1.0 - rest.len() as f64 / cloud.len() as f64;
    assert!((share - 0.3).abs() < 0.07, "{share}");
    let loss = LossConfig::default();
    for mut trainer in both_forms(&gpu) {
        let mut learn = |cloud: &GaussianCloud, dropout: Dropout| {
            let on_gpu = upload(&gpu, cloud);
            let views = [TrainingView { dropout, ..TrainingView::new(camera, &image) }];
            let reports = trainer.steps(&on_gpu, &views, &loss, &AdamConfig::default()).unwrap();
            (reports[0].loss.total(&loss), reports[0].counts.visible, on_gpu.download(&gpu).unwrap())
        };
        let (dropped, visible, moved) = learn(&cloud, dropout);
        let (expected, visible_then, _) = learn(&rest, Dropout::default());
        assert!((dropped - expected).abs() < 1e-4 * expected && visible == visible_then, "{dropped} is not {expected}");
        let whole = learn(&cloud, Dropout::default()).0;
        assert!((dropped - whole).abs() > 1e-3 * whole, "the dropout does nothing here: {dropped}, {whole}");
        let has_moved = |i: usize| moved.get(i) != cloud.get(i);
        assert!((0..cloud.len()).all(|i| !(is_dropped(i as u32) && has_moved(i))));
        assert!((0..cloud.len()).filter(|i| has_moved(*i)).count() > 100);
    }
}

#[test]
fn depth_that_is_trusted_by_a_quarter_counts_as_if_it_had_a_quarter_of_the_weight() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(9);
    let camera = crate::common::camera(&mut rng, 64, 48);
    let cloud = crate::common::scene(&mut rng, 200, ShDegree::default());
    let (image, wide) = target(&mut rng, camera.pinhole);
    let image = upload_target(&gpu, &image, &wide);
    let learn = |depth_confidence: f32, depth_weight: f32| {
        let mut trainer = Trainer::new(gpu.clone()).unwrap();
        let on_gpu = upload(&gpu, &cloud);
        let views = [TrainingView { depth_confidence, ..TrainingView::new(camera, &image) }; 5];
        let loss = LossConfig { depth_weight, ..LossConfig::default() };
        let reports = trainer.steps(&on_gpu, &views, &loss, &AdamConfig::default()).unwrap();
        (on_gpu.download(&gpu).unwrap(), reports[4].loss.total(&loss))
    };
    let (trusted, weighted, whole) = (learn(0.25, 0.8), learn(1.0, 0.2), learn(1.0, 0.8));
    // A power of two: to the bit.
    assert_eq!(trusted, weighted);
    assert_ne!(trusted.0, whole.0, "the weight does nothing here");
}

/// Of a colour and its double, where half the exposure has both in 8 bits; what is brighter than white counts as white.
#[test]
fn an_exposed_target_counts_as_the_one_in_the_maps_exposure() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(10);
    let camera = crate::common::camera(&mut rng, 64, 48);
    let cloud = crate::common::scene(&mut rng, 200, ShDegree::default());
    let (image, wide) = target(&mut rng, camera.pinhole);
    let of = |change: &dyn Fn(u8) -> u8| {
        let mut changed = image.clone();
        changed.pixels_mut().for_each(|p| p.0 = p.0.map(change));
        upload_target(&gpu, &changed, &wide)
    };
    let learn = |change: &dyn Fn(u8) -> u8, gain: f32| {
        let target = of(change);
        let mut trainer = Trainer::new(gpu.clone()).unwrap();
        let on_gpu = upload(&gpu, &cloud);
        let exposure = Exposure([gain.ln(); 3]);
        let views = [TrainingView { exposure, ..TrainingView::new(camera, &target) }; 3];
        let loss = LossConfig::default();
        let reports = trainer.steps(&on_gpu, &views, &loss, &AdamConfig::default()).unwrap();
        f64::from(reports[2].loss.total(&loss))
    };
    let (expected, other) = (learn(&|v| v / 2, 1.0), learn(&|v| v / 2, 1.3));
    let double = learn(&|v| v / 2 * 2, 2.0);
    assert!((double - expected).abs() < 1e-3 * expected, "{double} is not {expected}");
    assert!((other - expected).abs() > 1e-2 * expected, "the exposure does nothing here");
    let (white, beyond) = (learn(&|_| 255, 1.0), learn(&|_| 200, 0.5));
    assert!((white - beyond).abs() < 1e-6 * white, "{white} is not {beyond}");
}

#[test]
fn pairs_that_outgrow_their_buffers_are_never_dropped() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(5);
    let camera = crate::common::camera(&mut rng, 640, 480);
    let mut cloud = crate::common::scene(&mut rng, 400, ShDegree::default());
    cloud.log_scales.iter_mut().for_each(|s| *s = glam::Vec3::splat(-0.5));
    cloud.raw_opacities.iter_mut().for_each(|o| *o = -3.0);
    let mut rasterizer = Rasterizer::new(gpu.clone()).unwrap();
    let on_gpu = upload(&gpu, &cloud);
    // 400 Gaussians over most of 1200 tiles: more than the first buffers hold.
    let first = rasterizer.render(&on_gpu, &camera, BACKGROUND).unwrap();
    let counts = rasterizer.finish().unwrap().unwrap();
    assert!(counts.intersections > 131_072, "the scene does not overflow: {counts:?}");
    assert_eq!(first, rasterizer.render(&on_gpu, &camera, BACKGROUND).unwrap(), "rendering is repeatable to the bit");

    // Training: steps that did not fit are repeated, and all of them count.
    let (image, wide) = target(&mut rng, camera.pinhole);
    let image = upload_target(&gpu, &image, &wide);
    let mut trainer = Trainer::new(gpu.clone()).unwrap();
    let views = [TrainingView::new(camera, &image); 3];
    let loss = LossConfig::default();
    let reports = trainer.steps(&on_gpu, &views, &loss, &AdamConfig::default()).unwrap();
    assert!(reports.iter().all(|r| r.counts.intersections > 131_072 && r.loss.l1 > 0.0), "{reports:?}");
    assert!(reports[2].loss.total(&loss) < reports[0].loss.total(&loss), "the steps did not descend");
}
