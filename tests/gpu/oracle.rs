//! What the comparisons of the GPU with the f64 oracle share.

use std::sync::Arc;

use fastrand::Rng;
use image::RgbImage;
use keysplat::geometry::Pinhole;
use keysplat::gpu::Gpu;
use keysplat::optimise::{ImageGradients, TargetImage, Trainer};
use keysplat::render::{BlendForm, Blending, GpuCloud};
use keysplat::splat::model::Surface;
use keysplat::splat::{GaussianCloud, ViewCamera};
use keysplat::verification::reference::loss::Target64;
use keysplat::verification::reference::project_backward::backward;
use keysplat::verification::reference::{Cutoffs, Gaussian64, Image64, ImageGradient64, View64, cloud64, rasterize_forward};
use nalgebra::Vector3;

/// Relative error by norm that the project promises for images and for gradients.
pub const IMAGE_TOLERANCE: f64 = 1e-4;
/// The same for gradients.
pub const GRADIENT_TOLERANCE: f64 = 1e-3;
/// Behind the map.
pub const BACKGROUND: [f32; 3] = [0.2, 0.5, 0.1];
/// Share of pixels whose median depth rounding may put at another Gaussian.
const OTHER_MEDIANS: f64 = 0.005;

pub fn view64(camera: &ViewCamera, cloud: &GaussianCloud, surface: Surface) -> View64 {
    let background = Vector3::from(BACKGROUND).map(f64::from);
    View64 { camera: *camera, background, cutoffs: Cutoffs::Sharp, antialiased: cloud.antialiased, surface }
}

pub fn upload(gpu: &Gpu, cloud: &GaussianCloud) -> GpuCloud {
    let on_gpu = GpuCloud::of(gpu, cloud).unwrap();
    assert_eq!(on_gpu.len(), cloud.len());
    on_gpu
}

pub fn flat(cloud: &[Gaussian64]) -> Vec<f64> {
    cloud.iter().flat_map(Gaussian64::flat).collect()
}

/// A trainer of each form of the blending passes.
pub fn both_forms(gpu: &Arc<Gpu>) -> impl Iterator<Item = Trainer> {
    trainers(gpu, Surface::Volume)
}

/// The same of a surface.
pub fn trainers(gpu: &Arc<Gpu>, surface: Surface) -> impl Iterator<Item = Trainer> {
    BlendForm::ALL.into_iter().map(move |form| Trainer::with_blending(gpu.clone(), Blending { form, surface }).unwrap())
}

/// Renders on both and compares the images; returns the oracle's.
pub fn compare_images(gpu: &Arc<Gpu>, cloud: &GaussianCloud, camera: &ViewCamera, surface: Surface) -> Image64 {
    let expected = rasterize_forward::render(&view64(camera, cloud, surface), &cloud64(cloud));
    let colors = expected.color.iter().zip(&expected.depth).flat_map(|(c, d)| [c.x, c.y, c.z, *d]);
    let wanted: Vec<f64> = colors.chain(expected.transmittance.iter().copied()).collect();
    for mut trainer in trainers(gpu, surface) {
        let rendered = trainer.render(&upload(gpu, cloud), camera, BACKGROUND).unwrap();
        let got: Vec<f64> = rendered.color_depth.iter().flatten().chain(&rendered.transmittance).map(|v| f64::from(*v)).collect();
        let error = crate::common::relative_error(&got, &wanted);
        assert!(error < IMAGE_TOLERANCE, "image, {:?}: {error:e}", trainer.form());
        for c in 0..if surface == Surface::Planar { 3 } else { 0 } {
            let got: Vec<f64> = rendered.surface.iter().map(|s| f64::from(s[c])).collect();
            let wanted: Vec<f64> = expected.surface.iter().map(|s| s[c]).collect();
            let error = crate::common::relative_error(&got, &wanted);
            assert!(error < IMAGE_TOLERANCE, "surface, channel {c}, {:?}: {error:e}", trainer.form());
        }
        if surface == Surface::Planar {
            let is_other = |i: &usize| (f64::from(rendered.median_depth(*i)) - expected.median_depth[*i]).abs() > 1e-4;
            let other = (0..expected.depth.len()).filter(is_other).count() as f64;
            assert!(other <= OTHER_MEDIANS * expected.depth.len() as f64 + 1.0, "{other} median depths, {:?}", trainer.form());
        }
    }
    expected
}

pub fn image_gradients(by_image: &ImageGradient64) -> ImageGradients {
    let color_depth =
        by_image.color.iter().zip(&by_image.depth).map(|(c, d)| [c.x as f32, c.y as f32, c.z as f32, *d as f32]).collect();
    let surface = by_image.surface.iter().map(|s| [s.x as f32, s.y as f32, s.z as f32, 0.0]).collect();
    ImageGradients { color_depth, alpha: by_image.alpha.iter().map(|a| *a as f32).collect(), surface }
}

/// Pushes the same image gradient back on both and compares.
pub fn compare_gradients(gpu: &Arc<Gpu>, cloud: &GaussianCloud, camera: &ViewCamera, surface: Surface, rng: &mut Rng) {
    let pixels = (camera.pinhole.width * camera.pinhole.height) as usize;
    let by_image = crate::common::image_gradient(rng, pixels);
    let by = image_gradients(&by_image);
    let expected = backward(&view64(camera, cloud, surface), &cloud64(cloud), &by_image);
    let wanted = flat(&expected);
    for mut trainer in trainers(gpu, surface) {
        let form = trainer.form();
        let got = trainer.gradients_from_image(&upload(gpu, cloud), camera, BACKGROUND, &by).unwrap();
        let got_flat = flat(&cloud64(&got.cloud));
        assert!(got_flat.iter().all(|v| v.is_finite()), "a gradient is not finite");
        let error = crate::common::relative_error(&got_flat, &wanted);
        assert!(error < GRADIENT_TOLERANCE, "gradient, {form:?}: {error:e}");
        let dots = got_flat.iter().zip(&wanted).fold((0.0, 0.0, 0.0), |s, (x, y)| (s.0 + x * y, s.1 + x * x, s.2 + y * y));
        assert!(dots.0 / (dots.1 * dots.2).sqrt() > 1.0 - 1e-6, "gradient's direction, {form:?}");
    }
}

/// Both of both surfaces; returns the oracle's image of the volume.
pub fn compare(gpu: &Arc<Gpu>, cloud: &GaussianCloud, camera: &ViewCamera, rng: &mut Rng) -> Image64 {
    let [volume, _] = [Surface::Volume, Surface::Planar].map(|surface| {
        let expected = compare_images(gpu, cloud, camera, surface);
        compare_gradients(gpu, cloud, camera, surface, rng);
        expected
    });
    volume
}

/// A target image for the loss, 8-bit like a real one, whose left border and some other pixels the camera did not record.
pub fn target(rng: &mut Rng, pinhole: Pinhole) -> (RgbImage, Target64) {
    let (width, height) = (pinhole.width, pinhole.height);
    let color = RgbImage::from_fn(width, height, |_, _| image::Rgb([rng.u8(..), rng.u8(..), rng.u8(..)]));
    let metres: Vec<f32> =
        (0..width * height).map(|i| if i % 4 == 0 { 0.0 } else { crate::common::between(rng, 0.5, 3.0) }).collect();
    let wide = Target64 {
        width: width as usize,
        height: height as usize,
        color: color.pixels().map(|p| Vector3::from(p.0).map(|v| f64::from(v) / 255.0)).collect(),
        depth: metres.iter().map(|m| f64::from(*m)).collect(),
        valid: (0..width * height).map(|i| i % width > 4 && i % 13 != 0).collect(),
    };
    (color, wide)
}

pub fn upload_target(gpu: &Gpu, image: &RgbImage, wide: &Target64) -> TargetImage {
    let metres: Vec<f32> = wide.depth.iter().map(|m| *m as f32).collect();
    TargetImage::masked(gpu, image, Some(&metres), Some(&wide.valid)).unwrap()
}
