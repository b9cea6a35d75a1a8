//! A keyframe that a correction moves takes its Gaussians and its depth along.

use image::{Rgb, RgbImage};
use keysplat::geometry::{Pinhole, Se3};
use keysplat::mapping::{DensityConfig, DensityStrategy, DepthSource, Keyframe, Mapper, MappingConfig, PoseUpdate};
use keysplat::render::Rendered;
use keysplat::sequence::{DepthImage, RectifiedImage};
use keysplat::splat::{GaussianCloud, ViewCamera};
use nalgebra::Vector3;

/// Large enough for training at half the size.
const PINHOLE: Pinhole = Pinhole { fx: 80.0, fy: 80.0, cx: 41.5, cy: 31.5, width: 84, height: 64 };

fn keyframe(id: usize, world_from_camera: Se3) -> Keyframe {
    let (width, height) = (PINHOLE.width, PINHOLE.height);
    let color = RgbImage::from_fn(width, height, |x, y| Rgb([(x * 3) as u8, (y * 4) as u8, ((x / 6 + y / 6) % 2 * 200) as u8]));
    let metres = (0..width * height).map(|i| 2.0 + 0.01 * (i % width) as f32).collect();
    let image = RectifiedImage { pinhole: PINHOLE, color, depth: Some(DepthImage { width, height, metres }), valid: None };
    Keyframe::new(id, world_from_camera, image)
}

fn view(mapper: &mut Mapper, world_from_camera: &Se3) -> Rendered {
    mapper.render(&ViewCamera { pinhole: PINHOLE, camera_from_world: world_from_camera.inverse() }).unwrap()
}

/// Mean absolute difference of colours and depths.
fn difference(a: &Rendered, b: &Rendered) -> f32 {
    let values = a.color_depth.iter().flatten().zip(b.color_depth.iter().flatten());
    values.map(|(a, b)| (a - b).abs()).sum::<f32>() / (4 * a.color_depth.len()) as f32
}

/// Without control of density the Gaussians stay in the order of their keyframes.
fn config() -> MappingConfig {
    let density = DensityConfig { strategy: DensityStrategy::None, ..Default::default() };
    let mut config = MappingConfig { first_iterations: 20, iterations_per_keyframe: 5, density, ..Default::default() };
    (config.plane_sweep.enabled, config.plane_sweep.depth_confidence) = (false, 1.0);
    config
}

/// A keyframe whose depth is that of landmarks. A corner was not recorded.
fn without_sensor(id: usize, world_from_camera: Se3) -> Keyframe {
    let mut keyframe = keyframe(id, world_from_camera);
    keyframe.depth_source = DepthSource::Landmarks { right: None };
    keyframe.image.valid = Some((0..PINHOLE.width * PINHOLE.height).map(|i| i % PINHOLE.width > 4 || i > 900).collect());
    keyframe
}

#[test]
fn gaussians_follow_their_keyframe() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let mut mapper = Mapper::new(gpu, &config()).unwrap();
    let here = Se3::identity();
    // Looks the other way: the two share nothing.
    let there = Se3::new(Vector3::new(0.0, 0.0, -1.0), Vector3::y() * std::f64::consts::PI);
    let first = mapper.insert(&keyframe(0, here), &|| false).unwrap();
    mapper.insert(&keyframe(3, there), &|| false).unwrap();
    let before: GaussianCloud = mapper.download().unwrap();
    let (first_view, second_view) = (view(&mut mapper, &here), view(&mut mapper, &there));

    let updates = |poses: &[(usize, Se3)]| -> Vec<PoseUpdate> { poses.iter().map(|(k, p)| PoseUpdate::rigid(*k, *p)).collect() };
    assert_eq!(mapper.update_poses(&updates(&[(3, there), (0, here), (77, here)])).unwrap(), 0);
    assert_eq!(mapper.download().unwrap(), before);

    let moved = there * Se3::new(Vector3::new(0.05, -0.02, 0.03), Vector3::new(0.02, 0.06, -0.03));
    assert_eq!(mapper.update_poses(&updates(&[(3, moved), (0, here)])).unwrap(), before.len() - first.gaussians);
    let after = mapper.download().unwrap();
    assert_eq!(after.means[..first.gaussians], before.means[..first.gaussians]);
    assert!(after.means[first.gaussians..].iter().zip(&before.means[first.gaussians..]).all(|(a, b)| a.distance(*b) > 0.01));
    assert_eq!((&after.log_scales, &after.raw_opacities), (&before.log_scales, &before.raw_opacities));
    assert!(before.sh.iter().any(|c| c.length() > 0.01) && after.sh != before.sh);
    // They look from the moved camera as they did before, and the others did not stir.
    assert!(difference(&view(&mut mapper, &moved), &second_view) < 1e-3);
    assert!(difference(&view(&mut mapper, &here), &first_view) < 1e-6);
    assert!(difference(&view(&mut mapper, &there), &second_view) > 0.05);
    // Small ones as well.
    let refined = |k: i32| moved * Se3::translation(5e-4 * f64::from(k), 0.0, 0.0);
    let moved_by: Vec<usize> = (1..=20).map(|k| mapper.update_poses(&updates(&[(3, refined(k))])).unwrap()).collect();
    assert_eq!(moved_by, [before.len() - first.gaussians; 20]);
    assert!(difference(&view(&mut mapper, &refined(20)), &second_view) < 1e-3);
    // The map goes on from there.
    let report = mapper.insert(&keyframe(4, moved), &|| false).unwrap();
    assert!(report.psnr_db.is_finite() && report.gaussians >= after.len() / 2);
}

/// A closed loop without measured depth: the keyframe sees the same, at another distance.
#[test]
fn gaussians_and_depth_are_scaled_with_their_keyframe() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let mut config = config();
    (config.loss.depth_weight, config.refine.steps) = (2.0, 150);
    let mut mapper = Mapper::new(gpu, &config).unwrap();
    let (here, there) = (Se3::identity(), Se3::new(Vector3::new(0.0, 0.0, -1.0), Vector3::y() * std::f64::consts::PI));
    let first = mapper.insert(&without_sensor(0, here), &|| false).unwrap();
    mapper.insert(&without_sensor(3, there), &|| false).unwrap();
    let before = mapper.download().unwrap();
    let (first_view, second_view) = (view(&mut mapper, &here), view(&mut mapper, &there));
    let of_second = before.len() - first.gaussians;

    let moved = there * Se3::new(Vector3::new(0.3, -0.1, 0.2), Vector3::new(0.2, 0.6, -0.3));
    let updates = [(there, 1.003), (there, 1.003), (there, 0.997), (moved, 1.4), (moved, 1.0)];
    let update = |(world_from_camera, scale)| [PoseUpdate { keyframe: 3, world_from_camera, scale }];
    let moved_by = updates.map(|u| mapper.update_poses(&update(u)).unwrap());
    assert_eq!(moved_by, [of_second, of_second, of_second, of_second, 0]);
    let scale: f64 = updates.iter().map(|(_, scale)| scale).product();
    let scaled_view = |rendered: &Rendered| {
        let mut scaled = rendered.clone();
        scaled.color_depth.iter_mut().for_each(|pixel| pixel[3] *= scale as f32);
        scaled
    };
    assert!(difference(&view(&mut mapper, &moved), &scaled_view(&second_view)) < 1e-3);
    assert!(difference(&view(&mut mapper, &here), &first_view) < 1e-6);

    // Training towards its depth keeps it where it is.
    let mut refinement = mapper.begin_refinement().unwrap();
    while mapper.refine(&mut refinement, &|| false).unwrap().is_some() {}
    let rendered = view(&mut mapper, &moved);
    let target = keyframe(3, moved).image.depth.unwrap().metres;
    let seen = (0..target.len()).filter(|i| rendered.alpha(*i) > 0.5);
    let mut ratios: Vec<f32> = seen.map(|i| rendered.expected_depth(i) / target[i]).collect();
    assert!(ratios.len() > target.len() * 3 / 4, "{} pixels", ratios.len());
    ratios.sort_by(f32::total_cmp);
    let ratio = f64::from(ratios[ratios.len() / 2]);
    assert!((ratio / scale - 1.0).abs() < 0.01, "{ratio} instead of {scale}");
}

/// Wherever the images are, a resumed mapper has the scaled depths to the bit.
#[test]
fn scaled_depths_are_resumed() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    for max_host_bytes in [1 << 30, 0] {
        let mut config = MappingConfig { first_iterations: 2, iterations_per_keyframe: 2, ..config() };
        (config.limits.max_gpu_images, config.limits.max_host_bytes) = (8, max_host_bytes);
        let keyframes: Vec<Keyframe> =
            (0..12).map(|id| without_sensor(id, Se3::translation(0.1 * id as f64, 0.0, 0.0))).collect();
        let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
        for keyframe in &keyframes {
            mapper.insert(keyframe, &|| false).unwrap();
        }
        let before = bytes(&mapper);
        let update = |k: &Keyframe| PoseUpdate { keyframe: k.id, world_from_camera: k.world_from_camera, scale: 1.37 };
        let updates: Vec<PoseUpdate> = keyframes.iter().map(update).collect();
        assert_eq!(mapper.update_poses(&updates).unwrap(), mapper.gaussians());
        mapper.update_poses(&[PoseUpdate { scale: 1.004, ..updates[5] }]).unwrap();
        let state = mapper.state(None).unwrap();
        assert_ne!(bytes(&mapper), before);
        let mut resumed = Mapper::restore(gpu.clone(), &config, &state, None).unwrap();
        keyframes.iter().for_each(|keyframe| resumed.insert_again(keyframe, &state).unwrap());
        assert!(bytes(&resumed) == bytes(&mapper));
        for mapper in [&mut mapper, &mut resumed] {
            assert!(mapper.update_poses(&[PoseUpdate { scale: 1.004, ..updates[5] }]).unwrap() > 0);
            let mut refinement = mapper.begin_refinement().unwrap();
            mapper.refine(&mut refinement, &|| false).unwrap();
        }
        assert_eq!(resumed.download().unwrap(), mapper.download().unwrap());
    }
}

fn bytes(mapper: &Mapper) -> Vec<u8> {
    postcard::to_stdvec(&mapper.state(None).unwrap()).unwrap()
}
