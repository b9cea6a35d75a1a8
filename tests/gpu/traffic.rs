//! What passes between host and adapter. A software adapter hides it; on a GPU each command, upload and wait has a latency.

use std::sync::Arc;

use fastrand::Rng;
use image::RgbImage;
use keysplat::gpu::{Gpu, TrafficCount};
use keysplat::mapping::{Mapper, MappingConfig};
use keysplat::optimise::{AdamConfig, LossConfig, TargetImage, Trainer, TrainingView};
use keysplat::render::BlendForm;
use keysplat::splat::ShDegree;

use crate::common::requirements::adapter;
use crate::mapper::keyframe;
use crate::oracle::upload;

const STEPS: usize = 10;

fn of<T>(gpu: &Gpu, act: impl FnOnce() -> T) -> (TrafficCount, T) {
    let before = gpu.traffic();
    let done = act();
    (gpu.traffic() - before, done)
}

#[test]
fn steps_are_one_submission_with_one_upload_and_one_wait() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(3);
    // Enough tiles that their numbers take two passes to sort.
    let camera = crate::common::camera(&mut rng, 320, 240);
    let cloud = crate::common::scene(&mut rng, 300, ShDegree::default());
    let on_gpu = upload(&gpu, &cloud);
    let target = TargetImage::new(&gpu, &RgbImage::from_pixel(320, 240, image::Rgb([90, 120, 30])), None).unwrap();
    let views = [TrainingView::new(camera, &target); STEPS];
    for form in BlendForm::ALL {
        let mut trainer = Trainer::with_blending(gpu.clone(), form).unwrap();
        let (traffic, _) = of(&gpu, || trainer.steps(&on_gpu, &views, &LossConfig::default(), &AdamConfig::default()).unwrap());
        // The narrow form sorts by radix, in four passes of three.
        let dispatches = match form {
            BlendForm::Wide => 13,
            BlendForm::Narrow => 25,
        };
        assert_eq!(traffic.dispatches, dispatches * STEPS as u64, "{form:?}");
        assert_eq!((traffic.submissions, traffic.uploads, traffic.waits, traffic.clears), (1, 1, 1, 0), "{form:?}: {traffic:?}");
        assert!(traffic.bytes_read <= 4096, "{form:?}: {traffic:?}");
    }
}

/// After the first keyframe: one wait for the render, one for the steps with what density control needs, one for the steps after it.
#[test]
fn a_keyframe_takes_three_waits() {
    let Some(gpu) = adapter() else { return };
    let mut mapper = Mapper::new(gpu.clone(), &MappingConfig::default()).unwrap();
    let each: Vec<TrafficCount> =
        (0..6).map(|id| of(&gpu, || mapper.insert(&keyframe(id, true), &|| false).unwrap()).0).collect();
    assert!(each[1..].iter().all(|traffic| traffic.waits <= 3), "{each:?}");
    // A word for each Gaussian, 16 bits for each cell, 8 bytes for each sample, and the logs of the steps.
    let image = keyframe(0, true).image;
    let (pixels, cells) =
        (image.color.width() * image.color.height(), image.color.width().div_ceil(2) * image.color.height().div_ceil(2));
    let most = |gaussians: usize| 4 * gaussians as u64 + u64::from(2 * cells + 8 * pixels.min(1 << 14)) + 32 * 256;
    assert!(each[1..].iter().all(|traffic| traffic.bytes_read <= most(mapper.gaussians())), "{each:?}");
    // A keyframe's own uploads, and those of its Gaussians: none follows from the number of steps.
    let uploads = |steps_per_keyframe: usize| {
        let mut config = MappingConfig::default();
        config.refine.steps_per_keyframe = steps_per_keyframe;
        let (gpu, mut mapper) = (gpu.clone(), Mapper::new(gpu.clone(), &config).unwrap());
        last_uploads(&gpu, &mut mapper)
    };
    assert_eq!(uploads(1), uploads(4));
}

fn last_uploads(gpu: &Arc<Gpu>, mapper: &mut Mapper) -> u64 {
    (0..2).map(|id| of(gpu, || mapper.insert(&keyframe(id, true), &|| false).unwrap()).0.uploads).last().unwrap()
}
