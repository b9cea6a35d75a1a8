//! Scores of density control on the GPU against the f64 oracle. Needs an adapter; says so loudly and passes where there is none.

use fastrand::Rng;
use image::{Rgb, RgbImage};
use keysplat::optimise::{AdamConfig, ErrorPixels, LossConfig, PlanarConfig, TargetImage, Trainer, TrainingView, ssim_phase};
use keysplat::render::{Blending, GpuCloud};
use keysplat::splat::ShDegree;
use keysplat::verification::reference::loss::{LossWeights, Target64, loss};
use keysplat::verification::reference::scores::scores;
use keysplat::verification::reference::{View64, cloud64, rasterize_forward};
use nalgebra::Vector3;

use crate::oracle::view64;

const TOLERANCE: f64 = 1e-3;

#[test]
fn scores_are_those_of_their_definition() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let (loss_config, wrong_config) =
        (LossConfig { depth_weight: 0.0, ..LossConfig::default() }, ErrorPixels { error_ratio: 1.2, noise: 0.05 });
    let mut clear_cuts = 0;
    let still = PlanarConfig { normal_weight: 0.0, spread_weight: 0.0, ..PlanarConfig::default() };
    for (seed, blending) in (0..3).flat_map(|seed| Blending::all().map(move |blending| (seed, blending))) {
        let mut rng = Rng::with_seed(40 + seed);
        let camera = crate::common::camera(&mut rng, 40, 24);
        let cloud = crate::common::scene(&mut rng, 40, ShDegree::ALL[0]);
        let (width, height) = (camera.pinhole.width, camera.pinhole.height);
        let image = RgbImage::from_fn(width, height, |_, _| Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]));

        let view = View64 { background: Vector3::zeros(), ..view64(&camera, &cloud, blending.surface) };
        let cloud_64 = cloud64(&cloud);
        let rendered = rasterize_forward::render(&view, &cloud_64);
        let color: Vec<Vector3<f64>> = image.pixels().map(|p| Vector3::from(p.0.map(|c| f64::from(c) / 255.0))).collect();
        let errors: Vec<f64> = rendered.color.iter().zip(&color).map(|(a, b)| (a - b).abs().sum() / 3.0).collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let threshold = (f64::from(wrong_config.error_ratio) * mean).max(f64::from(wrong_config.noise));
        let wrong: Vec<bool> = errors.iter().map(|e| *e > threshold).collect();
        let clear_cut = errors.iter().all(|e| (e - threshold).abs() > 1e-4);
        let weights = LossWeights { ssim: f64::from(loss_config.ssim_weight), depth: 0.0, precise_depth: 1.0, phase: [0, 0] };
        let ([width, height], pixels) = ([width as usize, height as usize], errors.len());
        let target = Target64 { width, height, color, depth: vec![0.0; pixels], valid: vec![true; pixels] };
        let (total, by_image) = loss(&rendered, &target, &weights);
        let expected = scores(&view, &cloud_64, &by_image, &wrong);

        let mut trainer = Trainer::with_blending(gpu.clone(), blending).unwrap().with_planar(still);
        let mut on_gpu = GpuCloud::new(&gpu, cloud.sh_degree, cloud.len()).unwrap();
        on_gpu.append(&gpu, &cloud).unwrap();
        let target = TargetImage::new(&gpu, &image, None).unwrap();
        let view = TrainingView { scored: Some(wrong_config), ..TrainingView::new(camera, &target) };
        trainer.begin_scores(&on_gpu).unwrap();
        // Nothing moves, and the step in between, which is not scored, gives the other two the same windows of SSIM: both score the same.
        let still = AdamConfig::default().scaled(0.0, 0.0);
        let views = [view, TrainingView { scored: None, ..view }, view];
        assert_eq!([ssim_phase(0), ssim_phase(2)], [[0, 0]; 2]);
        trainer.steps(&on_gpu, &views, &loss_config, &still).unwrap();
        let found = trainer.read_scores(&on_gpu).unwrap();

        let compare = |name: &str, found: Vec<f32>, expected: Vec<f64>| {
            let found: Vec<f64> = found.into_iter().map(f64::from).collect();
            let error = crate::common::relative_error(&found, &expected);
            assert!(error < TOLERANCE, "{name}, seed {seed}, {blending:?}: {error:e}");
        };
        compare("Σ w", found.iter().map(|s| s.weight_sum).collect(), expected.iter().map(|s| 2.0 * s.weight_sum).collect());
        compare("largest w", found.iter().map(|s| s.weight_max).collect(), expected.iter().map(|s| s.weight_max).collect());
        compare("gradient", found.iter().map(|s| s.gradient).collect(), expected.iter().map(|s| 2.0 * s.gradient).collect());
        let absolute = expected.iter().map(|s| 2.0 * s.absolute_gradient).collect();
        compare("absolute gradient", found.iter().map(|s| s.absolute_gradient).collect(), absolute);
        let size = expected.iter().map(|s| s.depth / camera.pinhole.fx).collect();
        compare("metres per pixel", found.iter().map(|s| s.metres_per_pixel).collect(), size);
        clear_cuts += usize::from(clear_cut);
        if clear_cut {
            let wrong = expected.iter().map(|s| 2.0 * s.error_pixels).collect();
            compare("wrong pixels", found.iter().map(|s| s.error_pixels).collect(), wrong);
            let weighted = expected.iter().map(|s| 2.0 * s.error_pixels * total).collect();
            compare("weighted wrong pixels", found.iter().map(|s| s.weighted_error_pixels).collect(), weighted);
        }
        let views = |s: &f32, e: f64| *s == if e > 0.0 { 2.0 } else { 0.0 };
        assert!(found.iter().zip(&expected).all(|(s, e)| views(&s.views, e.weight_sum)), "seed {seed}, {blending:?}");
    }
    assert!(clear_cuts > 0, "high-error pixels were never compared");
}
