//! Steps that leave tiles out. Needs an adapter; says so loudly and passes where there is none.

use fastrand::Rng;
use glam::Vec3;
use image::{Rgb, RgbImage};
use keysplat::gpu::Gpu;
use keysplat::optimise::{AdamConfig, LossConfig, StepReport, TargetImage, TileSampling, Trainer, TrainingView};
use keysplat::render::{BlendForm, GpuCloud, Rasterizer};
use keysplat::splat::{GaussianCloud, ShDegree};

const LOSS: LossConfig = LossConfig { ssim_weight: 0.2, depth_weight: 0.0, precise_depth_metres: 2.0 };
/// Tiles below the noise never, all others always.
const NOISE_ONLY: TileSampling = TileSampling { share: 1e6, min_share: 0.0, noise: 0.02 };
const WIDTH: u32 = 128;
/// SSIM's windows carry the right half's error into the nearest column of tiles of the left half: pixels.
const WORKED: f64 = 16.0;
/// No Gaussian reaches further, pixels.
const RADIUS: f64 = 8.0;

struct Steps<'a> {
    gpu: std::sync::Arc<Gpu>,
    form: BlendForm,
    cloud: &'a GaussianCloud,
    camera: keysplat::splat::ViewCamera,
    image: &'a RgbImage,
}

impl Steps<'_> {
    /// The map after a step of each kind, one after the other on the same target, and what they reported. The first moves nothing.
    fn run(&self, skips: &[Option<TileSampling>]) -> (GaussianCloud, Vec<StepReport>) {
        let mut trainer = Trainer::with_form(self.gpu.clone(), self.form).unwrap();
        let mut on_gpu = GpuCloud::new(&self.gpu, self.cloud.sh_degree, self.cloud.len()).unwrap();
        on_gpu.append(&self.gpu, self.cloud).unwrap();
        let target = TargetImage::new(&self.gpu, self.image, None).unwrap();
        let mut reports = Vec::new();
        for (i, skip) in skips.iter().enumerate() {
            let lr_scale = if i == 0 { 0.0 } else { 1.0 };
            let view = TrainingView { lr_scale, tile_sampling: *skip, ..TrainingView::new(self.camera, &target) };
            reports.extend(trainer.steps(&on_gpu, &[view], &LOSS, &AdamConfig::default()).unwrap());
        }
        (on_gpu.download(&self.gpu).unwrap(), reports)
    }
}

#[test]
fn a_tile_below_the_noise_is_left_out_and_the_others_learn_as_before() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    for form in BlendForm::ALL {
        let mut rng = Rng::with_seed(3);
        let camera = crate::common::camera(&mut rng, WIDTH, 64);
        let mut cloud = crate::common::scene(&mut rng, 150, ShDegree::ALL[1]);
        let in_camera = |mean: &Vec3| camera.camera_from_world * nalgebra::Point3::from(mean.to_array().map(f64::from));
        for i in 0..cloud.len() {
            // Five pixels across.
            let metres = in_camera(&cloud.means[i]).z / camera.pinhole.fx;
            cloud.log_scales[i] = Vec3::splat((1.2 * metres.abs()).ln() as f32);
        }
        let mut rasterizer = Rasterizer::with_form(gpu.clone(), form).unwrap();
        let mut on_gpu = GpuCloud::new(&gpu, cloud.sh_degree, cloud.len()).unwrap();
        on_gpu.append(&gpu, &cloud).unwrap();
        let rendered = rasterizer.render(&on_gpu, &camera, [0.0; 3]).unwrap();
        // The left half is as it should be.
        let image = RgbImage::from_fn(WIDTH, 64, |x, y| {
            let [r, g, b, _] = rendered.color_depth[(y * WIDTH + x) as usize].map(|c| (c * 255.0).round() as u8);
            if x < WIDTH / 2 { Rgb([r, g, b]) } else { Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]) }
        });
        let steps = Steps { gpu: gpu.clone(), form, cloud: &cloud, camera, image: &image };
        let (plain, plain_reports) = steps.run(&[None, None]);
        let (skipping, reports) = steps.run(&[Some(NOISE_ONLY), Some(NOISE_ONLY)]);
        assert_eq!(plain_reports[0], reports[0], "what was never seen is not left out");
        assert!(reports[1].counts.intersections < plain_reports[1].counts.intersections * 7 / 10, "{:?}", reports[1].counts);
        let psnr = [&plain_reports[1], &reports[1]].map(|r| r.loss.psnr_db());
        assert!((psnr[0] - psnr[1]).abs() < 0.01, "the loss of what was left out is remembered: {psnr:?}");
        let (mut still, mut same) = (0, 0);
        for i in 0..cloud.len() {
            let p = in_camera(&cloud.means[i]);
            let column = camera.pinhole.fx * p.x / p.z + camera.pinhole.cx;
            let inside = p.z > 0.2 && (0.0..f64::from(WIDTH)).contains(&column);
            let from_middle = column - f64::from(WIDTH / 2);
            if inside && from_middle < -WORKED - RADIUS {
                assert_eq!(skipping.get(i), cloud.get(i), "Gaussian {i} of a tile that was left out moved");
                still += 1;
            } else if inside && from_middle > 0.0 {
                let (a, b) = (skipping.means[i] - cloud.means[i], plain.means[i] - cloud.means[i]);
                assert!((a - b).length() <= 1e-3 * b.length() + 1e-7, "Gaussian {i}: {a} instead of {b}");
                same += usize::from(b.length() > 0.0);
            }
        }
        assert!(still > 10 && same > 10, "{still} and {same} Gaussians compared");
    }
}

/// Drawn in proportion to their loss, tiles still all come up.
#[test]
fn every_tile_comes_up_now_and_then() {
    let Some(gpu) = crate::common::requirements::adapter() else { return };
    let mut rng = Rng::with_seed(4);
    let camera = crate::common::camera(&mut rng, WIDTH, 64);
    let cloud = crate::common::scene(&mut rng, 200, ShDegree::ALL[0]);
    let image = RgbImage::from_fn(WIDTH, 64, |x, _| Rgb([if x < WIDTH / 2 { 30 } else { rng.u8(..) }; 3]));
    let steps = Steps { gpu, form: BlendForm::Narrow, cloud: &cloud, camera, image: &image };
    let skip = TileSampling { share: 0.4, min_share: 0.1, noise: 0.0 };
    let (moved, reports) = steps.run(&[Some(skip); 60]);
    let mean = reports[1..].iter().map(|r| f64::from(r.counts.intersections)).sum::<f64>()
        / 59.0
        / f64::from(reports[0].counts.intersections);
    assert!((0.2..0.7).contains(&mean), "{mean} of the work was done");
    let (all, _) = steps.run(&[None; 60]);
    let moves = |to: &GaussianCloud| (0..cloud.len()).filter(|&i| to.means[i] != cloud.means[i]).count();
    assert_eq!(moves(&moved), moves(&all));
    assert!(reports[59].loss.total(&LOSS) < 0.9 * reports[0].loss.total(&LOSS));
    assert_eq!(steps.run(&[Some(skip); 60]).0, moved, "the draws repeat");
}
