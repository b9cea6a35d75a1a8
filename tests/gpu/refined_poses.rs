//! The mapper moves keyframes that came with a wrong pose to where their images say, the same to the bit each time.

use std::sync::Arc;

use image::{Rgb, RgbImage};
use keysplat::geometry::{Pinhole, Se3, se3};
use keysplat::gpu::Gpu;
use keysplat::mapping::{DepthSource, Keyframe, Mapper, MappingConfig, PoseUpdate, RefinePosesConfig, RefinedPair};
use keysplat::sequence::{DepthImage, RectifiedImage};
use keysplat::splat::GaussianCloud;
use nalgebra::{Point3, Vector3, Vector6};

const PINHOLE: Pinhole = Pinhole { fx: 90.0, fy: 90.0, cx: 47.5, cy: 35.5, width: 96, height: 72 };
const KEYFRAMES: usize = 6;
const DISTURBED: usize = 3;

/// A box before a wall: depth along z, and the point, that a ray from `eye` meets.
fn hit(eye: &Point3<f64>, ray: &Vector3<f64>) -> Point3<f64> {
    let at = |z: f64| eye + ray * ((z - eye.z) / ray.z);
    let front = at(1.5);
    if front.x.abs() < 0.4 && front.y.abs() < 0.3 { front } else { at(2.2) }
}

fn colour(p: &Point3<f64>) -> Rgb<u8> {
    let wave = |a: f64| (127.0 + 100.0 * a.sin()) as u8;
    Rgb([wave(9.0 * p.x + 2.0 * p.z), wave(8.0 * p.y - 4.0 * p.x), wave(11.0 * (p.x + p.y) + p.z)])
}

/// What a camera there sees, without noise.
fn image(world_from_camera: &Se3) -> RectifiedImage {
    let (width, height) = (PINHOLE.width, PINHOLE.height);
    let ray =
        |x: u32, y: u32| Vector3::new((f64::from(x) - PINHOLE.cx) / PINHOLE.fx, (f64::from(y) - PINHOLE.cy) / PINHOLE.fy, 1.0);
    let eye = Point3::from(world_from_camera.translation.vector);
    let point = |x: u32, y: u32| hit(&eye, &(world_from_camera.rotation * ray(x, y)));
    let color = RgbImage::from_fn(width, height, |x, y| colour(&point(x, y)));
    let depth = |i: u32| (world_from_camera.inverse() * point(i % width, i / width)).z as f32;
    let metres = (0..width * height).map(depth).collect();
    RectifiedImage { pinhole: PINHOLE, color, depth: Some(DepthImage { width, height, metres }), valid: None }
}

/// A walk along the wall, world_from_camera.
fn truth(id: usize) -> Se3 {
    let t = id as f64;
    se3::exp(&Vector6::new(0.06 * t, 0.02 * t * (3.0 - t), 0.03 * t, 0.01 * t, -0.02 * t, 0.015 * t))
}

/// Where the tracker has it.
fn tracked(id: usize) -> Se3 {
    let wrong = Vector6::new(0.006, -0.005, 0.004, 0.003, 0.004, -0.003);
    if id == DISTURBED { truth(id) * se3::exp(&wrong) } else { truth(id) }
}

/// What a mapper makes of the walk: the refined poses and the map.
fn refined(gpu: &Arc<Gpu>, refine_poses: RefinePosesConfig) -> (Vec<RefinedPair>, GaussianCloud) {
    let config = MappingConfig { iterations_per_keyframe: 60, refine_poses, ..Default::default() };
    let mut mapper = Mapper::new(gpu.clone(), &config).unwrap();
    for id in 0..KEYFRAMES {
        let covisible = (0..id).rev().collect();
        let (world_from_camera, image) = (tracked(id), image(&truth(id)));
        let keyframe = Keyframe { id, world_from_camera, image, depth_source: DepthSource::Sensor, covisible };
        mapper.insert(&keyframe, &|| false).unwrap();
    }
    let (pairs, map) = (mapper.refined(), mapper.download().unwrap());
    // The tracker moves all that it knows, as after a loop: refinements go along, and so do the Gaussians.
    let motion = se3::exp(&Vector6::new(0.5, -0.2, 0.1, 0.1, 0.3, -0.2));
    let moved: Vec<_> = (0..KEYFRAMES).map(|id| PoseUpdate::rigid(id, motion * tracked(id))).collect();
    assert_eq!(mapper.update_poses(&moved).unwrap(), map.len());
    for (before, after) in pairs.iter().zip(mapper.refined()) {
        let difference = before.keyframe_from_relative * after.keyframe_from_relative.inverse();
        assert!(se3::log(&difference).norm() < 1e-9 && before.relative_to == after.relative_to);
    }
    (pairs, map)
}

/// How far a pose of `keyframe` relative to `other` is from the truth: metres, radians.
fn error(keyframe: usize, other: usize, keyframe_from_other: &Se3) -> (f64, f64) {
    let difference = keyframe_from_other * truth(other).inverse() * truth(keyframe);
    (difference.translation.vector.norm(), difference.rotation.angle())
}

#[test]
fn a_disturbed_keyframe_returns_to_the_truth() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let off = RefinePosesConfig::default();
    let on = RefinePosesConfig { enabled: true, lr_rotation: 3e-4, lr_translation: 6e-4, pull: 0.0, ..off.clone() };
    assert!(refined(&gpu, RefinePosesConfig { enabled: false, ..off }).0.is_empty());
    let (pairs, map) = refined(&gpu, on.clone());
    assert!(pairs.len() >= 4, "{pairs:?}");
    let before = error(DISTURBED, 0, &(tracked(DISTURBED).inverse() * truth(0)));
    for pair in &pairs {
        assert!(pair.sigma_rotation_rad > 0.0 && pair.sigma_translation_metres > pair.sigma_rotation_rad);
        let after = error(pair.keyframe, pair.relative_to, &pair.keyframe_from_relative);
        eprintln!("{} from {}: {after:?}, disturbed {before:?}", pair.keyframe, pair.relative_to);
        assert!(after.0 < 0.5 * before.0 && after.1 < 0.5 * before.1);
    }
    assert!(pairs.iter().any(|p| p.keyframe == DISTURBED));
    assert_eq!(refined(&gpu, on), (pairs, map));
}
