//! Planar surfaces on the GPU against the f64 oracle; the passes themselves are compared in `against_reference`.

use crate::common::requirements::adapter;
use crate::oracle::*;
use fastrand::Rng;
use keysplat::optimise::{AdamConfig, LossConfig, PlanarConfig, TrainingView, ssim_phase};
use keysplat::splat::model::{MOST_SLANT, Surface};
use keysplat::splat::{Gaussian, GaussianCloud, ShDegree, ViewCamera};
use keysplat::verification::reference::loss::{LossWeights, loss};
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::surface::{self, SurfaceWeights};
use keysplat::verification::reference::{View64, cloud64, rasterize_forward};
use nalgebra::{Point3, Vector3};

#[test]
fn the_surface_loss_and_its_whole_gradient_agree() {
    let Some(gpu) = adapter() else { return };
    let planar = PlanarConfig { normal_weight: 0.3, spread_weight: 2.0, ..PlanarConfig::default() };
    let config = LossConfig { ssim_weight: 0.2, depth_weight: 0.3, precise_depth_metres: 1.5 };
    for seed in 0..3 {
        let mut rng = Rng::with_seed(60 + seed);
        let camera = crate::common::camera(&mut rng, 53, 37);
        // Many and large: most pixels are covered, and their depths vary little.
        let mut cloud = crate::common::scene(&mut rng, 300, ShDegree::ALL[seed as usize]);
        cloud.log_scales.iter_mut().for_each(|s| *s += glam::Vec3::splat(0.7));
        cloud.means.iter_mut().for_each(|m| m.z = 2.5 + 0.05 * (m.z - 2.5));
        let (image, wide) = target(&mut rng, camera.pinhole);
        let image = upload_target(&gpu, &image, &wide);
        let view = View64 { background: Vector3::zeros(), ..view64(&camera, &cloud, Surface::Planar) };
        let rendered = rasterize_forward::render(&view, &cloud64(&cloud));
        let weights = LossWeights { ssim: 0.2, depth: 0.3, precise_depth: 1.5, phase: ssim_phase(0).map(|p| p as usize) };
        let (_, by_image) = loss(&rendered, &wide, &weights);
        let weights = SurfaceWeights { normal: 0.3, spread: 2.0, min_alpha: 0.5, edge: 0.05 };
        let (value, by_surface) = surface::loss(&camera.pinhole, &rendered, &weights);
        let with_normals = by_surface.surface.iter().filter(|by| by.x != 0.0).count();
        assert!(value > 1e-3 && with_normals > by_surface.depth.len() / 4, "{value}, {with_normals} normals");
        let expected = flat(&backward(&view, &cloud64(&cloud), &by_image.clone().plus(&by_surface)));
        let without = flat(&backward(&view, &cloud64(&cloud), &by_image));
        assert!(crate::common::relative_error(&without, &expected) > 0.01, "the surface's loss does nothing here");
        for trainer in trainers(&gpu, Surface::Planar) {
            let mut trainer = trainer.with_planar(planar);
            let got = trainer.gradients(&upload(&gpu, &cloud), &camera, &image, &config).unwrap();
            let error = crate::common::relative_error(&flat(&cloud64(&got.cloud)), &expected);
            assert!(error < GRADIENT_TOLERANCE, "gradient, {:?}: {error:e}", trainer.form());
        }
    }
}

/// A wall of flat Gaussians, seen askew: the planar depth is that of the wall at each pixel.
#[test]
fn flat_gaussians_have_the_depth_of_their_plane() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(1);
    let camera: ViewCamera = crate::common::camera(&mut rng, 64, 48);
    let world_from_camera = camera.camera_from_world.inverse();
    // In the camera: through (0, 0, 3), turned by 50° about y.
    let turn = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 50f64.to_radians());
    let normal = turn * Vector3::z();
    let mut cloud = GaussianCloud::new(ShDegree::default());
    let [qx, qy, qz, qw] = (world_from_camera.rotation * turn).coords.map(|v| v as f32).into();
    for (i, k) in (-30..31).flat_map(|i| (-30..31).map(move |k| (i, k))) {
        let in_camera = Point3::new(0.0, 0.0, 3.0) + turn * Vector3::new(0.1 * f64::from(i), 0.1 * f64::from(k), 0.0);
        cloud.push(Gaussian {
            mean: (world_from_camera * in_camera).coords.map(|v| v as f32).data.0[0].into(),
            log_scale: glam::Vec3::new(-2.7, -2.7, -8.0),
            rotation: glam::Quat::from_xyzw(qx, qy, qz, qw),
            raw_opacity: 3.0,
            sh: vec![glam::Vec3::ZERO],
        });
    }
    let p = camera.pinhole;
    for mut trainer in trainers(&gpu, Surface::Planar) {
        let rendered = trainer.render(&upload(&gpu, &cloud), &camera, BACKGROUND).unwrap();
        let mut seen = 0;
        for i in (0..rendered.transmittance.len()).filter(|i| rendered.alpha(*i) > 0.9) {
            let pixel = nalgebra::Vector2::new((i % 64) as f64, (i / 64) as f64);
            let ray = p.unproject(&pixel, 1.0);
            let truth = 3.0 * normal.z / normal.dot(&ray);
            if !(0.5..6.0).contains(&truth) || (normal.xy() / normal.dot(&ray)).amax() > 0.9 * MOST_SLANT {
                continue;
            }
            seen += 1;
            // The plane's depth is linear about the centre of a Gaussian, and a little more than that further out.
            for depth in [rendered.expected_depth(i), rendered.median_depth(i)] {
                assert!((f64::from(depth) / truth - 1.0).abs() < 0.02, "pixel {pixel}: {depth} is not {truth}");
            }
            let found = rendered.normal(i, &p).unwrap();
            assert!(found.dot(&normal) < -0.99, "pixel {pixel:?}: {found:?} is not {normal:?} turned round");
            let slopes = [0, 1].map(|c| f64::from(rendered.surface[i][c] / rendered.alpha(i)));
            let slant = -normal.xy() / normal.dot(&ray) * truth;
            let off = [slopes[0] * p.fx - slant.x, slopes[1] * p.fy - slant.y];
            assert!(
                off.iter().all(|off| off.abs() < 0.1 * (truth + slant.norm())),
                "pixel {pixel:?}: off by {off:?} from {slant:?}, depth {truth}"
            );
        }
        assert!(seen > 500, "{seen} pixels of the wall");
    }
}

/// Each step takes the shortest axis nearer to its share of the second, and no other axis.
#[test]
fn gaussians_become_flat_by_steps() {
    let Some(gpu) = adapter() else { return };
    let mut rng = Rng::with_seed(21);
    let camera = crate::common::camera(&mut rng, 48, 32);
    let mut cloud = crate::common::scene(&mut rng, 60, ShDegree::default());
    // Equal axes: the last one shrinks.
    cloud.log_scales[3] = glam::Vec3::splat(-2.0);
    let (image, wide) = target(&mut rng, camera.pinhole);
    let image = upload_target(&gpu, &image, &wide);
    let adam = AdamConfig { ema_steps: 1.0, max_elongation: 1e6, lr_log_scale: 0.09, ..AdamConfig::default().scaled(0.0, 0.0) };
    let thickness = 0.2f32;
    for trainer in trainers(&gpu, Surface::Planar) {
        let mut trainer = trainer.with_planar(PlanarConfig { thickness, ..PlanarConfig::default() });
        let on_gpu = upload(&gpu, &cloud);
        let views = vec![TrainingView::new(camera, &image); 60];
        trainer.steps(&on_gpu, &views, &LossConfig { depth_weight: 0.0, ..LossConfig::default() }, &adam).unwrap();
        let flat = on_gpu.download(&gpu).unwrap();
        let changed: Vec<usize> = (0..cloud.len()).filter(|i| flat.get(*i) != cloud.get(*i)).collect();
        let is_flat = |i: &&usize| {
            let mut axes = flat.log_scales[**i].to_array();
            axes.sort_by(f32::total_cmp);
            axes[0] - axes[1] < thickness.ln() + 0.02
        };
        // Others are seldom seen.
        let count = changed.iter().filter(is_flat).count();
        assert!(changed.len() > 20 && count > changed.len() * 3 / 4, "{count} of {}", changed.len());
        assert!(!changed.contains(&3) || flat.log_scales[3].z < flat.log_scales[3].x - 0.5, "{:?}", flat.log_scales[3]);
    }
}
