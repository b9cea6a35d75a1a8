//! The order in which a tile's Gaussians are blended.

use fastrand::Rng;
use glam::{Quat, Vec3};
use keysplat::render::{BlendForm, Rasterizer};
use keysplat::splat::{Gaussian, GaussianCloud, ShDegree, ViewCamera, raw_opacity_from_opacity};
use nalgebra::{Point3, Vector2};

use crate::common::requirements::adapter;
use crate::oracle::upload;

const SIZE: (u32, u32) = (40, 20);
/// Little more than is blended at all: two thousand of these let light through.
const OPACITY: f32 = 0.0045;

/// Faint Gaussians, all of which are blended, many at one depth: their order shows in the colour.
fn veils(rng: &mut Rng, count: usize) -> (GaussianCloud, ViewCamera) {
    let camera = crate::common::camera(rng, SIZE.0, SIZE.1);
    let mut cloud = GaussianCloud::new(ShDegree::default());
    for _ in 0..count {
        let metres = 1.5 + 0.25 * f64::from(rng.u8(..8));
        let pixel = Vector2::new(f64::from(SIZE.0) * rng.f64(), f64::from(SIZE.1) * rng.f64());
        let mean = camera.camera_from_world.inverse() * Point3::from(camera.pinhole.unproject(&pixel, metres));
        let mut sh = vec![Vec3::ZERO; ShDegree::default().coefficients()];
        sh[0] = Vec3::new(rng.f32(), rng.f32(), rng.f32()) * 3.0 - 1.5;
        cloud.push(Gaussian {
            mean: Vec3::new(mean.x as f32, mean.y as f32, mean.z as f32),
            log_scale: Vec3::splat((4.0 * metres as f32).ln()),
            rotation: Quat::IDENTITY,
            raw_opacity: raw_opacity_from_opacity(OPACITY),
            sh,
        });
    }
    (cloud, camera)
}

#[test]
fn lists_of_any_length_have_one_order_in_both_forms() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(11);
    let mut forms = BlendForm::ALL.map(|form| Rasterizer::with_blending(gpu.clone(), form).unwrap());
    // Around powers of two, and beyond what workgroup memory holds.
    for count in [1, 2, 3, 63, 64, 65, 511, 512, 513, 1023, 1024, 1025, 1500, 4097] {
        let (cloud, camera) = veils(&mut rng, count);
        let on_gpu = upload(&gpu, &cloud);
        let [wide, narrow] = forms.each_mut().map(|form| form.render(&on_gpu, &camera, [0.1, 0.2, 0.3]).unwrap());
        let [again, _] = forms.each_mut().map(|form| form.render(&on_gpu, &camera, [0.1, 0.2, 0.3]).unwrap());
        assert_eq!(wide, again, "{count} Gaussians");
        let longest = wide.transmittance.iter().copied().fold(1.0, f32::min).ln() / (1.0 - OPACITY).ln();
        assert!(count < 100 || longest > 0.9 * count.min(2000) as f32, "{count} Gaussians: about {longest} blended");
        let difference =
            |a: &[f32; 4], b: &[f32; 4]| a.iter().zip(b).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f32::max);
        let worst = wide.color_depth.iter().zip(&narrow.color_depth).map(|(a, b)| difference(a, b)).fold(0.0, f32::max);
        assert!(worst < 1e-4, "{count} Gaussians: {worst}");
    }
}
