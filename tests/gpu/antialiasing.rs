//! Mip-Splatting's smoothing on the GPU against the f64 oracle.

use crate::common::requirements::adapter;
use crate::oracle::*;
use fastrand::Rng;
use keysplat::optimise::{AdamConfig, LossConfig, Trainer, TrainingView};
use keysplat::splat::model::Surface;
use keysplat::splat::{ShDegree, ViewCamera};
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::smoothing::{smooth, smooth_backward};
use keysplat::verification::reference::{Gaussian64, cloud64};

/// The sampling interval of the nearest view that moved a Gaussian smooths it, in what is rendered, learned and downloaded.
#[test]
fn smoothing_by_sampling_intervals_agrees() {
    let Some(gpu) = adapter() else { return };
    for degree in [ShDegree::ALL[0], ShDegree::ALL[2]] {
        let mut rng = Rng::with_seed(30);
        let camera = crate::common::camera(&mut rng, 61, 45);
        let mut cloud = crate::common::scene(&mut rng, 300, degree);
        cloud.antialiased = true;
        (0..cloud.len()).for_each(|i| cloud.log_scales[i] -= glam::Vec3::new((i % 3) as f32, (i % 2) as f32, 1.0));
        let (image, wide) = target(&mut rng, camera.pinhole);
        let image = upload_target(&gpu, &image, &wide);
        let mut nearer = camera;
        nearer.camera_from_world.translation.vector.z -= 0.3;
        let still = AdamConfig { max_elongation: 1e6, ..AdamConfig::default().scaled(0.0, 0.0) };
        for mut trainer in both_forms(&gpu) {
            let on_gpu = upload(&gpu, &cloud);
            let learn = |trainer: &mut Trainer, camera: &ViewCamera| {
                let views = [TrainingView::new(*camera, &image)];
                trainer.steps(&on_gpu, &views, &LossConfig::default(), &still).unwrap();
                on_gpu.sampling_intervals(&gpu).unwrap()
            };
            let depth = |camera: &ViewCamera, i: usize| {
                let mean = nalgebra::Point3::from(cloud.means[i].to_array().map(f64::from));
                (camera.camera_from_world * mean).z / camera.pinhole.fx.max(camera.pinhole.fy)
            };
            let first = learn(&mut trainer, &camera);
            let is_of =
                |camera: &ViewCamera, i: usize, interval: f32| (f64::from(interval) / depth(camera, i) - 1.0).abs() < 1e-4;
            assert!((0..cloud.len()).all(|i| first[i] == 0.0 || is_of(&camera, i, first[i])));
            assert!(first.iter().filter(|interval| **interval > 0.0).count() > cloud.len() / 2);
            let second = learn(&mut trainer, &nearer);
            assert!((0..cloud.len()).all(|i| second[i] == first[i] || is_of(&nearer, i, second[i])));
            assert!((0..cloud.len()).all(|i| first[i] == 0.0 || second[i] <= first[i]) && second != first);
            let intervals = learn(&mut trainer, &camera);
            assert_eq!(intervals, second, "a view from further away changes nothing");

            let gaussians = cloud64(&cloud);
            let pairs = || gaussians.iter().zip(intervals.iter().map(|interval| f64::from(*interval)));
            let smoothed: Vec<Gaussian64> = pairs().map(|(g, interval)| smooth(g, interval)).collect();
            let downloaded = on_gpu.download(&gpu).unwrap();
            let error = crate::common::relative_error(&flat(&cloud64(&downloaded)), &flat(&smoothed));
            assert!(downloaded.antialiased && error < 1e-6, "download: {error:e}");
            compare_images(&gpu, &downloaded, &camera, Surface::Volume);
            let rendered = trainer.render(&on_gpu, &camera, BACKGROUND).unwrap();
            let baked = trainer.render(&upload(&gpu, &downloaded), &camera, BACKGROUND).unwrap();
            let row = |rendered: &[[f32; 4]]| rendered.iter().flatten().map(|v| f64::from(*v)).collect::<Vec<f64>>();
            assert!(crate::common::relative_error(&row(&rendered.color_depth), &row(&baked.color_depth)) < IMAGE_TOLERANCE);

            let by_image = crate::common::image_gradient(&mut rng, 61 * 45);
            let by = image_gradients(&by_image);
            let by_smoothed = backward(&view64(&camera, &cloud, Surface::Volume), &smoothed, &by_image);
            let wanted: Vec<Gaussian64> =
                pairs().zip(&by_smoothed).map(|((g, interval), by)| smooth_backward(g, interval, by)).collect();
            let got = trainer.gradients_from_image(&on_gpu, &camera, BACKGROUND, &by).unwrap();
            let error = crate::common::relative_error(&flat(&cloud64(&got.cloud)), &flat(&wanted));
            assert!(error < GRADIENT_TOLERANCE, "gradient, {:?}: {error:e}", trainer.form());
        }
    }
}
