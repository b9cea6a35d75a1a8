//! Gaussians that rest: they are rendered, and stay as they are. Needs an adapter; says so loudly and passes where there is none.

mod common;

use std::sync::Arc;

use fastrand::Rng;
use image::{Rgb, RgbImage};
use keysplat::gpu::Gpu;
use keysplat::optimise::{AdamConfig, LossConfig, Optimiser, TargetImage, TrainingView};
use keysplat::render::{BlendForm, GpuCloud, Rasterizer};
use keysplat::splat::{GaussianCloud, ShDegree, ViewCamera};

const LOSS: LossConfig = LossConfig { ssim_weight: 0.2, depth_weight: 0.0, precise_depth_metres: 2.0 };

/// The map after some steps, the second half of it marked to rest.
fn stepped(
    gpu: &Arc<Gpu>,
    form: BlendForm,
    cloud: &GaussianCloud,
    camera: ViewCamera,
    image: &RgbImage,
    rests: bool,
) -> GaussianCloud {
    let mut rasterizer = Rasterizer::with_form(gpu.clone(), form).unwrap();
    let mut optimiser = Optimiser::new(&rasterizer).unwrap();
    let mut on_gpu = GpuCloud::new(gpu, cloud.sh_degree, cloud.len()).unwrap();
    on_gpu.append(gpu, cloud).unwrap();
    let marks: Vec<bool> = (0..cloud.len()).map(|i| i >= cloud.len() / 2).collect();
    on_gpu.mark_resting(gpu, &marks).unwrap();
    let target = TargetImage::new(gpu, image, None).unwrap();
    let view = TrainingView { rests, ..TrainingView::new(camera, &target) };
    // One step: after it the two maps differ, and so do their gradients.
    optimiser.steps(&mut rasterizer, &on_gpu, &[view], (&LOSS, &AdamConfig::default())).unwrap();
    on_gpu.download(gpu).unwrap()
}

#[test]
fn who_rests_stays_and_the_others_move_as_if_nobody_did() {
    let Ok(gpu) = Gpu::open(None) else {
        eprintln!("SKIPPED, Gaussians that rest were not tried: no adapter");
        return;
    };
    for form in BlendForm::ALL {
        let mut rng = Rng::with_seed(11);
        let camera = common::camera(&mut rng, 75, 52);
        let cloud = common::scene(&mut rng, 300, ShDegree::ALL[1]);
        let image = RgbImage::from_fn(75, 52, |_, _| Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]));
        let [all, some] = [false, true].map(|rests| stepped(&gpu, form, &cloud, camera, &image, rests));
        let moved = |map: &GaussianCloud, i: usize| map.get(i) != cloud.get(i);
        let half = cloud.len() / 2;
        assert!((half..cloud.len()).filter(|&i| moved(&all, i)).count() > 20, "marks alone hold nobody");
        assert!((half..cloud.len()).all(|i| !moved(&some, i)), "{form:?}");
        let mut compared = 0;
        for i in (0..half).filter(|&i| moved(&all, i)) {
            let (a, b) = (some.means[i] - cloud.means[i], all.means[i] - cloud.means[i]);
            assert!((a - b).length() <= 1e-3 * b.length() + 1e-7, "{form:?}, Gaussian {i}: {a} instead of {b}");
            compared += 1;
        }
        assert!(compared > 20, "{compared} Gaussians compared");
    }
}
