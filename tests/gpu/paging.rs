//! Maps larger than the GPU's memory: what no keyframe of the window sees waits on the disk, and nothing is lost.

use std::path::Path;
use std::sync::Arc;

use fastrand::Rng;
use glam::{Quat, Vec3};
use image::{Rgb, RgbImage};
use keysplat::geometry::{Pinhole, Se3};
use keysplat::gpu::Gpu;
use keysplat::mapping::{Keyframe, Mapper, MappingConfig, MappingError, PoseUpdate};
use keysplat::optimise::{AdamConfig, LossConfig, Pixels, TargetImage, Trainer, TrainingView};
use keysplat::render::{BlendForm, GpuCloud, HIDDEN, MapRenderer, Plan};
use keysplat::splat::model::Surface;
use keysplat::splat::{Gaussian, GaussianCloud, ShDegree, ViewCamera};
use nalgebra::Vector3;

use crate::common::requirements::adapter;
use crate::mapper::keyframe;

const KEYFRAMES: usize = 40;

fn config() -> MappingConfig {
    let mut config = MappingConfig { first_iterations: 10, iterations_per_keyframe: 10, ..Default::default() };
    config.insertion.flat_stride = config.insertion.stride;
    config
}

/// A wall of another colour every five metres.
fn elsewhere(id: usize) -> Keyframe {
    let mut keyframe = Keyframe { world_from_camera: Se3::translation(5.0 * id as f64, 0.0, 0.0), ..keyframe(id, true) };
    let shade = |pixel: &Rgb<u8>| Rgb([pixel.0[0], pixel.0[1], pixel.0[2] / 2 + (3 * id % 128) as u8]);
    let image = &keyframe.image.color;
    keyframe.image.color = RgbImage::from_fn(image.width(), image.height(), |x, y| shade(image.get_pixel(x, y)));
    keyframe
}

fn walk(gpu: &Arc<Gpu>, config: &MappingConfig, file: Option<&Path>) -> Mapper {
    let mut mapper = Mapper::new(gpu.clone(), config).unwrap().with_chunks(file.map(Into::into));
    (0..KEYFRAMES).for_each(|id| assert_eq!(mapper.insert(&elsewhere(id), &|| false).unwrap().id, id));
    mapper
}

/// Bound to a part of the memory that the whole map takes.
fn bounded(share: f64) -> Option<(Arc<Gpu>, MappingConfig, u64)> {
    let free = adapter()?;
    drop(walk(&free, &config(), None));
    let limit = (share * free.peak_bytes() as f64) as u64;
    let mut config = config();
    config.limits.max_gpu_bytes = Some(limit);
    Some((adapter()?, config, limit))
}

/// Mean absolute error of the map at each keyframe's view.
fn errors(gpu: &Arc<Gpu>, map: &GaussianCloud) -> Vec<f32> {
    let mut renderer = MapRenderer::new(gpu, map, Surface::Volume, usize::MAX).unwrap();
    let error = |id| {
        let (keyframe, rendered) = (elsewhere(id), renderer.render(&elsewhere(id).camera()).unwrap());
        let pixels = keyframe.image.color.pixels().zip(&rendered.color_depth);
        let sum: f32 =
            pixels.map(|(pixel, p)| (0..3).map(|k| (f32::from(pixel[k]) / 255.0 - p[k]).abs()).sum::<f32>() / 3.0).sum();
        sum / rendered.color_depth.len() as f32
    };
    (0..KEYFRAMES).map(error).collect()
}

#[test]
fn what_was_copied_out_comes_back_as_it_was() {
    let Some(gpu) = adapter() else { return };
    let rng = &mut Rng::with_seed(7);
    let degree = ShDegree::new(2).unwrap();
    let mut map = GpuCloud::new(&gpu, degree, 300).unwrap();
    map.append(&gpu, &crate::common::scene(rng, 300, degree)).unwrap();
    let elements = map.planes() * map.capacity();
    let noise: Vec<[f32; 4]> = (0..elements).map(|_| [rng.f32(), rng.f32(), rng.f32(), rng.f32()]).collect();
    [map.moments_1(), map.moments_2(), map.averages()].iter().for_each(|buffer| buffer.write(&gpu, 0, &noise));
    let places: Vec<u32> = (0..300).filter(|place| place % 3 == 1).collect();
    let rest: Vec<u32> = (0..300).filter(|place| place % 3 != 1).collect();
    let (out, others) = (map.copy_out(&gpu, &places).unwrap(), map.copy_out(&gpu, &rest).unwrap());
    assert_eq!((out.len(), others.len(), map.len()), (100, 200, 300));
    map.apply(&gpu, &Plan::removing(places)).unwrap();
    assert_eq!(map.copy_out(&gpu, &(0..200).collect::<Vec<_>>()).unwrap(), others);
    map.put_back(&gpu, &out).unwrap();
    assert_eq!(map.copy_out(&gpu, &(200..300).collect::<Vec<_>>()).unwrap(), out);
    assert_eq!(map.copy_out(&gpu, &(0..200).collect::<Vec<_>>()).unwrap(), others);
    let bytes = out.to_bytes();
    assert_eq!(keysplat::render::CloudPart::from_bytes(&bytes, degree, 100), Some(out));
    assert_eq!(keysplat::render::CloudPart::from_bytes(&bytes[1..], degree, 100), None);
}

#[test]
fn no_step_moves_what_is_fixed_until_it_is_free_again() {
    let Some(gpu) = adapter() else { return };
    let rng = &mut Rng::with_seed(3);
    let degree = ShDegree::new(1).unwrap();
    let mut map = GpuCloud::new(&gpu, degree, 90).unwrap();
    map.append(&gpu, &crate::common::scene(rng, 90, degree)).unwrap();
    let camera = crate::common::camera(rng, 48, 32);
    let image = RgbImage::from_fn(48, 32, |_, _| Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]));
    let target = TargetImage::new(&gpu, &image, None).unwrap();
    let mut trainer = Trainer::new(gpu.clone()).unwrap();
    // How many of the Gaussians at these places steps move.
    let mut moved = |map: &mut GpuCloud, places: &[u32]| {
        let before = map.copy_out(&gpu, places).unwrap();
        trainer.steps(map, &[TrainingView::new(camera, &target); 10], &LossConfig::default(), &AdamConfig::default()).unwrap();
        let after = map.copy_out(&gpu, places).unwrap();
        (0..places.len()).filter(|i| before.picked(&[*i]) != after.picked(&[*i])).count()
    };
    let (fixed, rest): (Vec<u32>, Vec<u32>) = (0..90).partition(|place| place % 3 == 1);
    map.fix(&gpu, &fixed).unwrap();
    assert_eq!(moved(&mut map, &fixed), 0);
    assert!(moved(&mut map, &rest) > 20);
    // They move up as the first of each three goes.
    map.apply(&gpu, &Plan::removing((0..90).step_by(3).collect())).unwrap();
    let moved_up: Vec<u32> = (0..60).step_by(2).collect();
    assert_eq!(moved(&mut map, &moved_up), 0);
    map.fix(&gpu, &[]).unwrap();
    assert!(moved(&mut map, &moved_up) > 10);
    // What is released elsewhere comes back free.
    map.fix(&gpu, &moved_up).unwrap();
    let mut out = map.copy_out(&gpu, &moved_up).unwrap();
    out.release();
    map.apply(&gpu, &Plan::removing(moved_up)).unwrap();
    map.put_back(&gpu, &out).unwrap();
    assert!(moved(&mut map, &(30..60).collect::<Vec<_>>()) > 10);
}

#[test]
fn what_is_blended_into_hidden_pixels_learns_nothing() {
    let Some(gpu) = adapter() else { return };
    let rng = &mut Rng::with_seed(5);
    let degree = ShDegree::new(1).unwrap();
    let scene = crate::common::scene(rng, 90, degree);
    let camera = crate::common::camera(rng, 48, 32);
    let recorded: Vec<u32> = (0..48 * 32).map(|_| rng.u32(..) | 0xff00_0000).collect();
    let mut target = TargetImage::new(&gpu, &RgbImage::new(48, 32), None).unwrap();
    target.offload();
    for form in BlendForm::ALL {
        let mut trainer = Trainer::with_blending(gpu.clone(), form).unwrap();
        // The Gaussians that a step moves where the left and the right half have these pixels instead of the recorded ones.
        let mut moved = |left: Option<u32>, right: Option<u32>| -> Vec<usize> {
            let mut map = GpuCloud::new(&gpu, degree, 90).unwrap();
            map.append(&gpu, &scene).unwrap();
            let color = (0..).zip(&recorded).map(|(i, pixel)| if i % 48 < 24 { left } else { right }.unwrap_or(*pixel)).collect();
            let pixels = Pixels { color, depth_metres: vec![0.0; 48 * 32] };
            let view = TrainingView { streamed: Some(&pixels), ..TrainingView::new(camera, &target) };
            let before = map.copy_out(&gpu, &(0..90).collect::<Vec<_>>()).unwrap();
            trainer.steps(&map, &[view], &LossConfig::default(), &AdamConfig::default()).unwrap();
            let after = map.copy_out(&gpu, &(0..90).collect::<Vec<_>>()).unwrap();
            (0..90).filter(|i| before.picked(&[*i]) != after.picked(&[*i])).collect()
        };
        let (on_the_left, on_the_right) = (moved(None, Some(0)), moved(Some(0), None));
        let alone: Vec<usize> = on_the_left.iter().copied().filter(|i| !on_the_right.contains(i)).collect();
        assert!(alone.len() > 10 && alone.len() + 5 < on_the_left.len(), "{alone:?} of {on_the_left:?}");
        assert_eq!(moved(None, Some(HIDDEN)), alone, "{form:?}");
    }
}

#[test]
fn memory_is_held_and_nothing_is_lost() {
    let Some((gpu, config, limit)) = bounded(0.6) else { return };
    let mut mapper = walk(&gpu, &config, None);
    assert!(gpu.peak_bytes() <= limit, "{} of {limit} bytes", gpu.peak_bytes());
    let (paging, resident) = (mapper.paging(), mapper.map().len());
    assert!(resident < mapper.gaussians() * 2 / 3 && paging.most_away > 1000, "{resident} of {}, {paging:?}", mapper.gaussians());
    let Some(free) = adapter() else { return };
    let whole = walk(&free, &self::config(), None).download().unwrap();
    let map = mapper.download().unwrap();
    assert_eq!(map.len(), mapper.gaussians());
    assert!(map.len() > whole.len() * 9 / 10, "{} of {}", map.len(), whole.len());
    for (id, (paged, whole)) in errors(&free, &map).into_iter().zip(errors(&free, &whole)).enumerate() {
        assert!(paged < 1.3 * whole + 0.005, "keyframe {id}: {paged} and {whole}");
    }
    // Who comes back finds what was there.
    let again = Keyframe { id: KEYFRAMES, ..elsewhere(1) };
    let report = mapper.insert(&again, &|| false).unwrap();
    assert!(report.inserted < 100 && mapper.paging().gaussians_in > 100, "{report:?} {:?}", mapper.paging());
    let mut refinement = mapper.begin_refinement().unwrap();
    while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
    assert!(gpu.peak_bytes() <= limit, "{} of {limit} bytes", gpu.peak_bytes());
    let refined = errors(&free, &mapper.download().unwrap());
    let mean = |errors: &[f32]| errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(mean(&refined) < mean(&errors(&free, &map)), "{refined:?}");
}

/// Bindings are the limit of one adapter, memory that of the other. Neither ends the run.
#[test]
fn a_map_that_fills_the_adapter_goes_on_beside_it() {
    const LARGEST: u64 = 8 << 20;
    let Some(free) = adapter() else { return };
    let mut config = config();
    config.sh_degree = ShDegree::new(3).unwrap();
    (config.insertion.stride, config.insertion.flat_stride) = (1, 1);
    let whole = walk(&free, &config, None).gaussians();
    let small = Gpu::open_small(None, LARGEST).unwrap();
    let poor = Gpu::open(None).unwrap();
    poor.limit_memory(free.peak_bytes() * 7 / 10);
    for gpu in [small, poor] {
        let mapper = walk(&gpu, &config, None);
        assert!(mapper.gaussians() > whole * 9 / 10, "{} of {whole}", mapper.gaussians());
        assert!(mapper.map().len() < mapper.gaussians() * 3 / 4, "{} {:?}", mapper.map().len(), mapper.paging());
        let errors = errors(&free, &mapper.download().unwrap());
        assert!(errors.iter().all(|error| *error < 0.1), "{errors:?}");
    }
}

#[test]
fn what_is_away_follows_its_keyframes() {
    let Some((gpu, config, _)) = bounded(0.6) else { return };
    let mut mapper = walk(&gpu, &config, None);
    let before = mapper.download().unwrap();
    let shift = Vector3::new(0.0, 0.5, 0.0);
    let update = |id| {
        let mut world_from_camera = elsewhere(id).world_from_camera;
        world_from_camera.translation.vector += shift;
        PoseUpdate::rigid(id, world_from_camera)
    };
    let updates: Vec<PoseUpdate> = (0..KEYFRAMES).map(update).collect();
    assert_eq!(mapper.update_poses(&updates).unwrap(), mapper.gaussians());
    let after = mapper.download().unwrap();
    let moved = before.means.iter().zip(&after.means).map(|(a, b)| *b - *a);
    assert!(moved.into_iter().all(|moved| (moved.y - 0.5).abs() < 1e-4 && moved.x.abs() + moved.z.abs() < 1e-4));
    assert!(before.sh.iter().zip(&after.sh).all(|(a, b)| a.distance(*b) < 1e-5));
    // Half of the keyframes go, wherever their Gaussians are.
    let gone: Vec<usize> = (0..KEYFRAMES / 2).collect();
    let removed = mapper.remove_keyframes(&gone).unwrap();
    let rest = mapper.download().unwrap();
    assert_eq!(rest.len() + removed, after.len());
    assert!(rest.means.iter().all(|mean| mean.x > 5.0 * (KEYFRAMES / 2) as f32 - 3.5), "{removed} of {}", after.len());
}

#[test]
fn a_damaged_file_is_named_and_a_file_of_an_earlier_run_goes() {
    let Some((gpu, config, _)) = bounded(0.6) else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("chunks.bin");
    std::fs::write(&file, b"of an earlier run").unwrap();
    let mut mapper = walk(&gpu, &config, Some(&file));
    let bytes = std::fs::read(&file).unwrap();
    assert!(bytes.len() > 100_000);
    std::fs::write(&file, vec![0; bytes.len()]).unwrap();
    let error = mapper.insert(&Keyframe { id: KEYFRAMES, ..elsewhere(1) }, &|| false).unwrap_err();
    assert!(matches!(&error, MappingError::Chunks { path, .. } if *path == file), "{error}");
    assert!(error.to_string().contains("has changed since it was written"), "{error}");
}

/// Before the first step nothing says which Gaussians are the most useful.
#[test]
fn a_bounded_number_before_any_step_is_an_even_sample() {
    let Some(gpu) = adapter() else { return };
    let mut config = MappingConfig { first_iterations: 0, iterations_per_keyframe: 0, ..config() };
    config.refine.steps_per_keyframe = 0;
    let whole = walk(&gpu, &config, None).gaussians();
    config.limits.max_gaussians = Some(whole / 4);
    let map = walk(&gpu, &config, None).download().unwrap();
    assert!((whole / 4 - KEYFRAMES..=whole / 4).contains(&map.len()), "{} of {whole}", map.len());
    let mut at = [0; KEYFRAMES];
    map.means.iter().for_each(|mean| at[(mean.x / 5.0).round().clamp(0.0, (KEYFRAMES - 1) as f32) as usize] += 1);
    let mean = map.len() / KEYFRAMES;
    assert!(at.iter().all(|count| (mean * 3 / 4..=mean * 5 / 4).contains(count)), "{at:?}");
}

#[test]
fn slabs_show_what_the_whole_map_shows() {
    let Some(gpu) = adapter() else { return };
    let rng = &mut Rng::with_seed(11);
    for degree in [0, 2] {
        let degree = ShDegree::new(degree).unwrap();
        let open = crate::common::scene(rng, 900, degree);
        let mut walled = wall(degree);
        walled.append(&open);
        for (map, surface) in
            [(&open, Surface::Volume), (&open, Surface::Planar), (&walled, Surface::Volume), (&walled, Surface::Planar)]
        {
            compare_slabs(&gpu, map, surface);
        }
    }
}

/// An opaque wall before the left half of what lies ahead.
fn wall(degree: ShDegree) -> GaussianCloud {
    let mut wall = GaussianCloud::new(degree);
    for (column, row) in (0..20).flat_map(|column| (0..20).map(move |row| (column, row))) {
        wall.push(Gaussian {
            mean: Vec3::new(-0.1 * column as f32, 0.1 * (row as f32 - 10.0), 1.0),
            log_scale: Vec3::new(-2.5, -2.5, -6.0),
            rotation: Quat::IDENTITY,
            raw_opacity: 6.0,
            sh: vec![Vec3::splat(0.5); degree.coefficients()],
        });
    }
    wall
}

fn compare_slabs(gpu: &Arc<Gpu>, map: &GaussianCloud, surface: Surface) {
    let pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
    let mut whole = MapRenderer::new(gpu, map, surface, usize::MAX).unwrap();
    let mut slabs = MapRenderer::new(gpu, map, surface, 130).unwrap();
    for turn in [0.0, 0.4, -0.7] {
        let camera_from_world = Se3::new(Vector3::new(0.0, 0.0, 0.3), Vector3::new(0.0, turn, 0.0));
        let camera = ViewCamera { pinhole, camera_from_world };
        let (a, b) = (whole.render(&camera).unwrap(), slabs.render(&camera).unwrap());
        let pixels = a.color_depth.iter().zip(&b.color_depth);
        let worst = pixels.map(|(a, b)| (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max)).fold(0.0, f32::max);
        let light = a.transmittance.iter().zip(&b.transmittance).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // Colours reach two.
        assert!(worst < 0.02 && light < 0.01, "degree {:?}, {surface:?}, {turn}: {worst} {light}", map.sh_degree);
        assert!(a.transmittance.iter().any(|light| *light < 0.5), "there is something to see");
    }
}
