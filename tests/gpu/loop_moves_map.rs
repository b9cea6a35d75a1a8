//! A keyframe that a closed loop moves takes its Gaussians along; a refined one does not.

use image::{Rgb, RgbImage};
use keysplat::geometry::{Pinhole, Se3};
use keysplat::mapping::{DensityConfig, DensityStrategy, DepthSource, Keyframe, Mapper, MappingConfig};
use keysplat::render::Rendered;
use keysplat::sequence::{DepthImage, RectifiedImage};
use keysplat::splat::{GaussianCloud, ShDegree, ViewCamera};
use nalgebra::Vector3;

const PINHOLE: Pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };

fn keyframe(id: usize, world_from_camera: Se3) -> Keyframe {
    let (width, height) = (PINHOLE.width, PINHOLE.height);
    let color = RgbImage::from_fn(width, height, |x, y| Rgb([(x * 4) as u8, (y * 5) as u8, ((x / 6 + y / 6) % 2 * 200) as u8]));
    let metres = (0..width * height).map(|i| 2.0 + 0.01 * (i % width) as f32).collect();
    let image = RectifiedImage { pinhole: PINHOLE, color, depth: Some(DepthImage { width, height, metres }), valid: None };
    Keyframe { id, world_from_camera, image, depth_source: DepthSource::Sensor, covisible: Vec::new() }
}

fn view(mapper: &mut Mapper, world_from_camera: &Se3) -> Rendered {
    mapper.render(&ViewCamera { pinhole: PINHOLE, camera_from_world: world_from_camera.inverse() }).unwrap()
}

/// Mean absolute difference of colours and depths.
fn difference(a: &Rendered, b: &Rendered) -> f32 {
    let values = a.color_depth.iter().flatten().zip(b.color_depth.iter().flatten());
    values.map(|(a, b)| (a - b).abs()).sum::<f32>() / (4 * a.color_depth.len()) as f32
}

#[test]
fn gaussians_follow_their_keyframe_when_it_moves_far() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    // Without control of density the Gaussians stay in the order of their keyframes. Higher harmonics would not turn with them.
    let density = DensityConfig { strategy: DensityStrategy::None, ..Default::default() };
    let sh_degree = ShDegree::new(0).unwrap();
    let config = MappingConfig { first_iterations: 20, iterations_per_keyframe: 5, density, sh_degree, ..Default::default() };
    let mut mapper = Mapper::new(gpu, &config).unwrap();
    let here = Se3::identity();
    // Looks the other way: the two share nothing.
    let there = Se3::new(Vector3::new(0.0, 0.0, -1.0), Vector3::y() * std::f64::consts::PI);
    let first = mapper.insert(&keyframe(0, here), &|| false).unwrap();
    mapper.insert(&keyframe(3, there), &|| false).unwrap();
    let before: GaussianCloud = mapper.download().unwrap();
    let (first_view, second_view) = (view(&mut mapper, &here), view(&mut mapper, &there));

    let refined = there * Se3::translation(0.004, 0.0, 0.0);
    assert_eq!(mapper.update_poses(&[(3, refined), (0, here), (77, here)]).unwrap(), 0);
    assert_eq!(mapper.download().unwrap(), before);

    let moved = refined * Se3::new(Vector3::new(0.05, -0.02, 0.03), Vector3::new(0.02, 0.06, -0.03));
    assert_eq!(mapper.update_poses(&[(3, moved), (0, here)]).unwrap(), before.len() - first.gaussians);
    let after = mapper.download().unwrap();
    assert_eq!(after.means[..first.gaussians], before.means[..first.gaussians]);
    assert!(after.means[first.gaussians..].iter().zip(&before.means[first.gaussians..]).all(|(a, b)| a.distance(*b) > 0.01));
    assert_eq!((&after.log_scales, &after.sh, &after.raw_opacities), (&before.log_scales, &before.sh, &before.raw_opacities));
    // They look from the moved camera as they did before, and the others did not stir.
    assert!(difference(&view(&mut mapper, &moved), &second_view) < 1e-3, "by all moves since they were inserted");
    assert!(difference(&view(&mut mapper, &here), &first_view) < 1e-6);
    assert!(difference(&view(&mut mapper, &there), &second_view) > 0.05);
    // Moves of a refinement each add up to one that is more.
    let step = |k: i32| moved * Se3::translation(0.004 * f64::from(k), 0.0, 0.0);
    let moved_by: Vec<usize> = (1..=3).map(|k| mapper.update_poses(&[(3, step(k))]).unwrap()).collect();
    assert_eq!(moved_by, [0, 0, before.len() - first.gaussians]);
    assert!(difference(&view(&mut mapper, &step(3)), &second_view) < 1e-3);
    // The map goes on from there.
    let report = mapper.insert(&keyframe(4, moved), &|| false).unwrap();
    assert!(report.psnr_db.is_finite() && report.gaussians >= after.len() / 2);
}
