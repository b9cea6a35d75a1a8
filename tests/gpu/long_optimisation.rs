//! Many steps on degenerate scenes and images that cannot be fitted: nothing may become NaN, explode, or grow into a needle. Needs an
//! adapter; says so loudly and passes where there is none.

use fastrand::Rng;
use glam::Vec3;
use image::{Rgb, RgbImage};
use keysplat::optimise::{AdamConfig, LossConfig, TargetImage, Trainer, TrainingView};
use keysplat::render::GpuCloud;
use keysplat::splat::ShDegree;

const SCENES: u64 = 12;
const STEPS: usize = 200;
const BATCH: usize = 20;

/// How many times longer than its second axis a Gaussian is.
fn elongation(log_scale: Vec3) -> f32 {
    let mut s = log_scale.to_array();
    s.sort_by(f32::total_cmp);
    (s[2] - s[1]).exp()
}

#[test]
fn two_hundred_steps_on_noise_end_finite() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let adam = AdamConfig::default();
    let mut trainer = Trainer::new(gpu.clone()).unwrap();
    let mut blunted = 0;
    for seed in 0..SCENES {
        let mut rng = Rng::with_seed(900 + seed);
        let camera = crate::common::camera(&mut rng, 48, 32);
        let mut cloud = crate::common::scene(&mut rng, 60, ShDegree::ALL[2]);
        for i in (0..cloud.len()).step_by(4) {
            cloud.log_scales[i].x += crate::common::between(&mut rng, -6.0, 6.0);
            cloud.raw_opacities[i] = crate::common::between(&mut rng, -8.0, 20.0);
        }
        let mut on_gpu = GpuCloud::new(&gpu, cloud.sh_degree, cloud.len()).unwrap();
        on_gpu.append(&gpu, &cloud).unwrap();
        // Noise, and a depth that has nothing to do with the scene.
        let image = RgbImage::from_fn(48, 32, |_, _| Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]));
        let depth: Vec<f32> =
            (0..48 * 32).map(|_| if rng.f32() < 0.2 { 0.0 } else { crate::common::between(&mut rng, 0.05, 60.0) }).collect();
        let target = TargetImage::new(&gpu, &image, Some(&depth)).unwrap();
        let view = TrainingView::new(camera, &target);
        let mut losses = Vec::new();
        for _ in 0..STEPS / BATCH {
            let reports = trainer.steps(&on_gpu, &[view; BATCH], &LossConfig::default(), &adam).unwrap();
            losses.extend(reports.iter().map(|r| r.loss.total(&LossConfig::default())));
        }
        assert!(losses.iter().all(|loss| loss.is_finite()), "scene {seed}: {losses:?}");
        assert!(losses[STEPS - 1] < losses[0], "scene {seed}: {} after {}", losses[STEPS - 1], losses[0]);
        let after = on_gpu.download(&gpu).unwrap();
        for i in 0..after.len() {
            let (before, now) = (cloud.get(i), after.get(i));
            let finite = now.mean.is_finite()
                && now.log_scale.is_finite()
                && now.rotation.is_finite()
                && now.raw_opacity.is_finite()
                && now.sh.iter().all(|c| c.is_finite());
            assert!(finite, "scene {seed}, Gaussian {i}: {now:?}");
            // Adam moves a log scale by no more than about its rate a step.
            let growth = (now.log_scale - before.log_scale).max_element();
            assert!(growth < 1.5 * STEPS as f32 * adam.lr_log_scale, "scene {seed}, Gaussian {i} grew by e^{growth}");
            if now != before {
                let limit = adam.max_elongation * 1.001;
                assert!(elongation(now.log_scale) <= limit, "scene {seed}, Gaussian {i} is a needle: {:?}", now.log_scale);
                blunted += usize::from(elongation(before.log_scale) > limit);
            }
        }
    }
    assert!(blunted > 0, "no needle was there to be blunted");
}
