//! The mapper, keyframe by keyframe.

use crate::common::requirements::adapter;
use std::sync::Arc;

use image::{Rgb, RgbImage};
use keysplat::geometry::{Pinhole, Se3};
use keysplat::mapping::{InitialMap, Keyframe, KeyframeReport, Mapper, MapperState, MappingConfig, PoseUpdate};
use keysplat::sequence::{DepthImage, RectifiedImage};
use keysplat::splat::{Exposure, Gaussian, unit_rotation};

const PINHOLE: Pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };

pub fn keyframe(id: usize, with_depth: bool) -> Keyframe {
    let (width, height) = (PINHOLE.width, PINHOLE.height);
    let color = RgbImage::from_fn(width, height, |x, y| Rgb([(x * 4) as u8, (y * 5) as u8, ((x / 6 + y / 6) % 2 * 200) as u8]));
    let depth = with_depth.then(|| DepthImage { width, height, metres: vec![2.0; (width * height) as usize] });
    let image = RectifiedImage { pinhole: PINHOLE, color, depth, valid: None };
    let world_from_camera = Se3::translation(0.01 * id as f64, 0.0, 0.0);
    Keyframe::new(id, world_from_camera, image)
}

#[test]
fn density_is_controlled_after_every_so_many_keyframes() {
    let Some(gpu) = adapter() else { return };
    for every in [1, 2, 3] {
        let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
        // No inserted Gaussian is as opaque as this.
        (config.density.every, config.density.min_opacity) = (every, 0.95);
        config.refine.steps_per_keyframe = 0;
        let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
        for id in 0..6 {
            let report = mapper.insert(&keyframe(id, true), &|| false).unwrap();
            assert_eq!(report.iterations, 5, "{report:?}");
            let is_controlled = (id + 1usize).is_multiple_of(every);
            assert_eq!((report.pruned > 0, report.gaussians == 0), (is_controlled, is_controlled), "every {every}: {report:?}");
        }
    }
}

#[test]
fn keyframes_before_the_first_depth_are_passed_over() {
    let Some(gpu) = adapter() else { return };
    let config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    for id in 0..2 {
        let report = mapper.insert(&keyframe(id, false), &|| false).unwrap();
        assert_eq!(report, KeyframeReport { id, ..Default::default() });
        assert!(mapper.has_not_begun());
    }
    assert_eq!(mapper.update_poses(&[PoseUpdate::rigid(0, Se3::identity())]).unwrap(), 0);
    // A checkpoint of a map that has not begun, or just has, is gone on from.
    let resume = |state: &MapperState, keyframes: &[Keyframe]| {
        let mut resumed = Mapper::restore(gpu.clone(), &config, state, None).unwrap();
        keyframes.iter().for_each(|keyframe| resumed.insert_again(keyframe, state).unwrap());
        resumed
    };
    let resumed = resume(&mapper.state(None).unwrap(), &[keyframe(0, false), keyframe(1, false)]);
    assert!(resumed.has_not_begun());
    let begun = mapper.insert(&keyframe(2, true), &|| false).unwrap();
    assert!(begun.inserted > 0 && begun.iterations == 5 + config.refine.steps_per_keyframe, "{begun:?}");
    let mut resumed = resume(&mapper.state(None).unwrap(), &[keyframe(0, false), keyframe(1, false), keyframe(2, true)]);
    resumed.insert(&keyframe(3, true), &|| false).unwrap();
    mapper.insert(&keyframe(3, true), &|| false).unwrap();
    assert_eq!(mapper.download().unwrap(), resumed.download().unwrap());
    let after = mapper.insert(&keyframe(4, false), &|| false).unwrap();
    assert!(after.inserted == 0 && after.iterations > 0 && after.gaussians > 0, "{after:?}");
}

/// Steps of the running epoch follow each keyframe.
#[test]
fn steps_over_all_keyframes_follow_each_one() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    config.refine.steps_per_keyframe = 3;
    let insert = |mapper: &mut Mapper, ids: std::ops::Range<usize>| {
        ids.for_each(|id| assert_eq!(mapper.insert(&keyframe(id, true), &|| false).unwrap().iterations, 5 + 3));
    };
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    insert(&mut mapper, 0..40);

    // Where the images are makes no difference: on the GPU, in memory, in a file.
    let whole = mapper.download().unwrap();
    for max_host_bytes in [1 << 30, 300_000, 0] {
        let mut bounded = config.clone();
        (bounded.limits.max_gpu_images, bounded.limits.max_host_bytes) = (10, max_host_bytes);
        let mut mapper = Mapper::new(gpu.clone(), &bounded).unwrap();
        insert(&mut mapper, 0..40);
        assert_eq!(mapper.download().unwrap(), whole, "{max_host_bytes} bytes");
    }

    // A resumed mapper continues the epoch.
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    insert(&mut mapper, 0..12);
    let state = mapper.state(None).unwrap();
    let mut resumed = Mapper::restore(gpu, &config, &state, None).unwrap();
    (0..12).for_each(|id| resumed.insert_again(&keyframe(id, true), &state).unwrap());
    [&mut mapper, &mut resumed].into_iter().for_each(|mapper| insert(mapper, 12..17));
    assert_eq!(mapper.download().unwrap(), resumed.download().unwrap());
}

/// An image-only keyframe changes nothing when it comes, and is learnt from afterwards.
#[test]
fn image_only_keyframes_are_learnt_from_and_insert_nothing() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    (config.refine.steps_per_keyframe, config.refine.final_epochs) = (0, 4);
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    mapper.insert(&keyframe(0, true), &|| false).unwrap();
    let before = mapper.download().unwrap();
    let dim = |id: usize| {
        let mut seen = Keyframe { image_only: true, ..keyframe(id, true) };
        seen.image.color.pixels_mut().for_each(|pixel| pixel.0 = pixel.0.map(|value| value / 8 * 5));
        seen
    };
    for id in 1..4 {
        let report = mapper.insert(&dim(id), &|| false).unwrap();
        assert_eq!((report.inserted, report.iterations, report.gaussians), (0, 0, before.len()), "{report:?}");
        assert!(report.exposure.0.iter().all(|gain| *gain < -0.1), "{report:?}");
    }
    assert_eq!(mapper.download().unwrap(), before);
    assert_eq!((mapper.full_keyframes(), mapper.image_exposures().map(|(id, _)| id).collect::<Vec<_>>()), (1, vec![1, 2, 3]));
    // A checkpoint of it is gone on from.
    let state = mapper.state(None).unwrap();
    let mut resumed = Mapper::restore(gpu, &config, &state, None).unwrap();
    resumed.insert_again(&keyframe(0, true), &state).unwrap();
    (1..4).for_each(|id| resumed.insert_again(&dim(id), &state).unwrap());
    for mapper in [&mut mapper, &mut resumed] {
        let steps = mapper.step_times().len();
        let mut refinement = mapper.begin_refinement().unwrap();
        while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
        assert!(mapper.step_times().len() >= steps + 4, "as many as for one keyframe");
    }
    assert_eq!(mapper.download().unwrap(), resumed.download().unwrap());
}

/// Of image-only keyframes in a row, one in so many is measured; the others lie between.
#[test]
fn exposures_of_image_only_keyframes_lie_between_measured_ones() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    config.exposure.measured_every = 4;
    let mut mapper = Mapper::new(gpu, &config).unwrap();
    let dim = |id: usize, image_only: bool| {
        let mut seen = Keyframe { image_only, ..keyframe(id, true) };
        seen.image.color.pixels_mut().for_each(|pixel| pixel.0 = pixel.0.map(|value| value / 8 * 5));
        seen
    };
    mapper.insert(&keyframe(0, true), &|| false).unwrap();
    // The fourth in a row is measured, and so is the keyframe at the end.
    for id in 1..7 {
        mapper.insert(&dim(id, true), &|| false).unwrap();
    }
    let red = |mapper: &Mapper| mapper.exposures().map(|(_, exposure)| exposure.0[0]).collect::<Vec<f32>>();
    let before = red(&mapper);
    assert!(before[4] < -0.1 && before[5..] == [before[4]; 2], "{before:?}");
    mapper.insert(&dim(8, false), &|| false).unwrap();
    let after = red(&mapper);
    let between = |i: usize, low: usize, high: usize, share: f32| after[low] + share * (after[high] - after[low]) - after[i];
    let off =
        [between(1, 0, 4, 0.25), between(2, 0, 4, 0.5), between(3, 0, 4, 0.75), between(5, 4, 7, 0.25), between(6, 4, 7, 0.5)];
    assert!(off.iter().all(|off| off.abs() < 1e-6) && after[..5] == before[..5], "{after:?}");
}

/// Steps that yield to keyframes go on over all keyframes until the next one waits.
#[test]
fn time_between_keyframes_goes_to_consolidation() {
    let Some(gpu) = adapter() else { return };
    let config =
        MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, yields_to_keyframes: true, ..Default::default() };
    let mut mapper = Mapper::new(gpu, &config).unwrap();
    for id in 0..4 {
        let polls = std::cell::Cell::new(0);
        let stop = || polls.replace(polls.get() + 1) >= 30;
        let report = mapper.insert(&keyframe(id, true), &stop).unwrap();
        assert!(report.iterations > 20 && report.iterations < 100, "{report:?}");
    }
}

#[test]
fn a_refinement_of_so_many_seconds_ends_by_the_clock() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    for (seconds, takes_steps) in [(0.0, false), (0.4, true)] {
        config.refine.seconds = Some(seconds);
        let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
        mapper.insert(&keyframe(0, true), &|| false).unwrap();
        let before = mapper.step_times().len();
        let mut refinement = mapper.begin_refinement().unwrap();
        while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
        assert_eq!(mapper.step_times().len() > before, takes_steps, "{seconds} s");
    }
}

/// Photos of one wall, every second one twice as bright.
#[test]
fn exposures_of_photos_are_measured_in_the_refinement() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { iterations_per_keyframe: 0, first_iterations: 0, ..MappingConfig::default() };
    (config.refine.steps, config.refine.density_every, config.exposure.refinements) = (240, 40, 3);
    let photo = |id: usize| {
        let mut photo = keyframe(id, true);
        let factor = if id.is_multiple_of(2) { 4 } else { 2 };
        photo.image.color.pixels_mut().for_each(|p| p.0 = p.0.map(|value| 20 + value / 6 * factor));
        photo
    };
    let mut mapper = Mapper::new(gpu, &config).unwrap();
    for id in 0..6 {
        mapper.insert(&photo(id), &|| false).unwrap();
    }
    assert!(mapper.exposures().all(|(_, exposure)| exposure == Exposure::default()), "there is no map to compare with");
    let mut refinement = mapper.begin_refinement().unwrap();
    while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
    let gains: Vec<f32> = mapper.exposures().map(|(_, exposure)| exposure.0[1]).collect();
    assert!(gains.iter().sum::<f32>().abs() < 1e-3, "the map's exposure is their mean: {gains:?}");
    let apart = gains[0] - gains[1];
    assert!((0.3..0.7).contains(&apart) && (0..6).all(|k| (gains[k] > 0.0) == k.is_multiple_of(2)), "{gains:?}");
}

/// Few Gaussians are opaque enough here: a round of control removes most, and none comes in the last fifth.
#[test]
fn nothing_is_pruned_at_the_end() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    (config.density.every, config.density.min_opacity, config.refine.final_epochs) = (1000, 0.95, 3);
    for (density_every, is_pruned) in [(9, true), (15, false)] {
        config.refine.density_every = density_every;
        let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
        (0..6).for_each(|id| assert!(mapper.insert(&keyframe(id, true), &|| false).unwrap().gaussians > 0));
        let mut refinement = mapper.begin_refinement().unwrap();
        let rounds: Vec<_> = std::iter::from_fn(|| mapper.refine(&mut refinement, &|| false).unwrap()).collect();
        assert_eq!(
            rounds.iter().any(|round| round.pruned > 0),
            is_pruned,
            "control every {density_every} of 18 steps: {rounds:?}"
        );
    }
}

#[test]
fn the_final_epochs_draw_each_keyframe_as_often() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 5, iterations_per_keyframe: 5, ..Default::default() };
    config.refine.final_epochs = 3;
    for (least, expected) in [(0, 18), (11, 18), (25, 25)] {
        config.refine.steps = least;
        let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
        for id in 0..6 {
            mapper.insert(&keyframe(id, true), &|| false).unwrap();
        }
        let before = mapper.step_times().len();
        let mut refinement = mapper.begin_refinement().unwrap();
        while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
        assert_eq!(mapper.step_times().len() - before, expected, "at least {least}");
    }
}

/// Density control would remove every Gaussian, and the steps move all that may be moved.
#[test]
fn what_is_frozen_never_changes_and_known_keyframes_insert_nothing() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 10, iterations_per_keyframe: 5, ..Default::default() };
    let mut run = Mapper::new(gpu.clone(), &config).unwrap();
    for id in 0..3 {
        run.insert(&keyframe(id, true), &|| false).unwrap();
    }
    let cloud = Arc::new(run.download().unwrap());
    let frozen = cloud.len() / 2;
    (config.density.min_opacity, config.refine.steps, config.refine.density_every) = (0.99, 60, 20);
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    mapper.add_map(&InitialMap { cloud: cloud.clone(), frozen }, 0).unwrap();
    for id in 0..3 {
        // Brighter than the map: there is something to learn.
        let known = Keyframe { exposure: Some(Exposure([0.5; 3])), ..keyframe(id, true) };
        let report = mapper.insert(&known, &|| false).unwrap();
        assert_eq!((report.inserted, report.iterations, report.exposure), (0, 0, Exposure([0.5; 3])));
    }
    let state = mapper.state(None).unwrap();
    assert_eq!(Mapper::restore(gpu, &config, &state, None).unwrap().map().frozen(), frozen);
    let mut refinement = mapper.begin_refinement().unwrap();
    while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
    let after = mapper.download().unwrap();
    assert!((frozen..cloud.len()).contains(&after.len()), "{} of {}", after.len(), cloud.len());
    // A map that begins a run has unit rotations.
    let unit = |i: usize| Gaussian { rotation: unit_rotation(cloud.rotations[i]), ..cloud.get(i) };
    for i in 0..frozen {
        assert_eq!(after.get(i), unit(i), "{i}");
    }
    assert!((frozen..after.len()).all(|i| after.get(i) != unit(i)));
}
