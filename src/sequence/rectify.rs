//! Frames as the mapper wants them: without lens distortion, at the mapping resolution.

use std::sync::Arc;

use image::{GrayImage, RgbImage};
use nalgebra::Vector2;

use super::sampling::Sampler;
use super::{DepthImage, Frame};
use crate::geometry::{Camera, Pinhole};

/// A frame seen through an ideal pinhole.
#[derive(Clone, Debug)]
pub struct RectifiedImage {
    /// The ideal pinhole, at the mapping resolution.
    pub pinhole: Pinhole,
    /// sRGB, of the pinhole's size.
    pub color: RgbImage,
    /// Depth of the same pixels, where the sensor has it.
    pub depth: Option<DepthImage>,
    /// `[height * width]`, row-major: whether the camera recorded the pixel and the mask keeps it. `None`: all of them.
    pub valid: Option<Arc<[bool]>>,
}

impl RectifiedImage {
    /// Whether the camera recorded pixel `i`, row-major.
    pub fn is_valid(&self, i: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid[i])
    }

    /// Takes all pixels as not recorded but the given ones, `[height * width]`.
    pub fn restrict(&mut self, to: &Arc<[bool]>) {
        let valid: Arc<[bool]> = match &self.valid {
            Some(valid) => valid.iter().zip(&**to).map(|(a, b)| *a && *b).collect(),
            None => to.clone(),
        };
        if let Some(depth) = &mut self.depth {
            depth.keep(&valid);
        }
        self.valid = Some(valid);
    }

    /// Median of the measured depths, metres; `None` if nothing was measured.
    pub fn median_depth_metres(&self) -> Option<f64> {
        let measured = self.depth.iter().flat_map(|depth| depth.metres.iter().copied().filter(|z| *z > 0.0));
        let mut depths: Vec<f32> = measured.collect();
        let middle = depths.len() / 2;
        (!depths.is_empty()).then(|| f64::from(*depths.select_nth_unstable_by(middle, f32::total_cmp).1))
    }
}

/// The precomputed map from mapping pixels to recorded pixels.
#[derive(Clone, Debug)]
pub struct Rectifier {
    pinhole: Pinhole,
    /// Positions in the recorded image, a group for each mapping pixel.
    sampler: Sampler,
    /// Mapping pixels per recorded pixel along x and y.
    scale: Vector2<f64>,
    /// Pixels whose centre lies in the recorded image; `None`: all.
    valid: Option<Arc<[bool]>>,
}

/// A point this far from where its distortion is undone again, pixels, lies beyond what the lens model describes.
const MAX_LENS_ERROR: f64 = 1.0;
/// Rounding, pixels.
const ON_BORDER: f64 = 1e-6;

impl Rectifier {
    /// A map from `camera`'s recorded images to a pinhole image `scale` times their size (0 < scale ≤ 1).
    pub fn new(camera: &Camera, scale: f64) -> Self {
        let pinhole = camera.pinhole.scaled(scale);
        // One bilinear sample per recorded pixel that a mapping pixel covers: a box filter.
        let samples = (1.0 / scale).round().max(1.0) as usize;
        let pixels = pinhole.width as usize * pinhole.height as usize;
        let group = samples * samples;
        let mut sources = Vec::with_capacity(pixels * group);
        let mut valid = Vec::with_capacity(pixels);
        let full = &camera.pinhole;
        let in_full = |ideal: Vector2<f64>| {
            let normalised = (ideal - Vector2::new(pinhole.cx, pinhole.cy)).component_div(&Vector2::new(pinhole.fx, pinhole.fy));
            normalised.component_mul(&Vector2::new(full.fx, full.fy)) + Vector2::new(full.cx, full.cy)
        };
        for y in 0..pinhole.height {
            for x in 0..pinhole.width {
                let ideal = Vector2::new(f64::from(x), f64::from(y));
                for sample in 0..group {
                    let offset = |k: usize| (k as f64 + 0.5) / samples as f64 - 0.5;
                    let source =
                        camera.distort_pixel(&in_full(ideal + Vector2::new(offset(sample % samples), offset(sample / samples))));
                    sources.push([source.x as f32, source.y as f32]);
                }
                let centre = camera.distort_pixel(&in_full(ideal));
                let lens_error = (camera.undistort_pixel(&centre) - in_full(ideal)).norm();
                valid.push(full.contains(&centre, -0.5 - ON_BORDER) && lens_error < MAX_LENS_ERROR);
            }
        }
        let scale = Vector2::new(pinhole.fx / camera.pinhole.fx, pinhole.fy / camera.pinhole.fy);
        let valid = valid.contains(&false).then(|| valid.into());
        let sampler = Sampler::new((full.width, full.height), &sources, group);
        Self { pinhole, sampler, scale, valid }
    }

    /// The ideal pinhole of the rectified images.
    pub fn pinhole(&self) -> Pinhole {
        self.pinhole
    }

    /// Resamples colour (box filter over bilinear samples; the border repeats) and depth (mean over the nearest surface; 0 at pixels that
    /// are not valid). Pixels that the mask does not keep are not valid.
    pub fn rectify(&self, frame: &Frame) -> RectifiedImage {
        let Pinhole { width, height, .. } = self.pinhole;
        let color = RgbImage::from_raw(width, height, self.sampler.means::<3>(&frame.color)).expect("a group for each pixel");
        let valid = frame.mask.as_ref().map_or_else(|| self.valid.clone(), |mask| self.valid_and_kept(mask));
        let depth = frame.depth.as_ref().map(|depth| {
            let mut depth = DepthImage { width, height, metres: self.sampler.nearest_surfaces(depth) };
            valid.iter().for_each(|valid| depth.keep(valid));
            depth
        });
        RectifiedImage { pinhole: self.pinhole, color, depth, valid }
    }

    /// The valid pixels all of whose recorded pixels the mask keeps; `None`: all.
    fn valid_and_kept(&self, mask: &GrayImage) -> Option<Arc<[bool]>> {
        let kept = self.sampler.kept(mask).enumerate();
        let valid: Arc<[bool]> = kept.map(|(i, kept)| kept && self.valid.as_ref().is_none_or(|valid| valid[i])).collect();
        valid.contains(&false).then_some(valid)
    }

    /// The right image of a pair, whose camera is like the left one.
    pub fn rectify_right(&self, right: &GrayImage) -> GrayImage {
        let Pinhole { width, height, .. } = self.pinhole;
        GrayImage::from_raw(width, height, self.sampler.means::<1>(right)).expect("a group for each pixel")
    }

    /// A depth image of a few points alone: pixels of the recorded camera without its distortion, and metres along z.
    pub fn sparse_depth(&self, points: &[(Vector2<f64>, f64)]) -> DepthImage {
        let (width, height) = (self.pinhole.width, self.pinhole.height);
        let mut metres = vec![0.0f32; (width * height) as usize];
        for (pixel, depth) in points {
            // Pixel centres stay where they belong when an image is resized.
            let at = pixel.add_scalar(0.5).component_mul(&self.scale).map(f64::floor);
            let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(width) && at.y < f64::from(height);
            if inside {
                let slot = &mut metres[at.y as usize * width as usize + at.x as usize];
                *slot = if *slot > 0.0 { slot.min(*depth as f32) } else { *depth as f32 };
            }
        }
        DepthImage { width, height, metres }
    }
}

/// Rectifiers that are kept: a table has megabytes, and each photo may have a camera of its own.
const RECTIFIERS_KEPT: usize = 4;

/// Rectifiers of several cameras, made when they are needed; the last few are kept.
#[derive(Debug)]
pub struct Rectifiers {
    scale: f64,
    /// The last one used first.
    kept: Vec<(Camera, Arc<Rectifier>)>,
}

impl Rectifiers {
    /// Of images `scale` times the recorded size, as in [`Rectifier::new`].
    pub fn new(scale: f64) -> Self {
        Self { scale, kept: Vec::new() }
    }

    /// The rectifier of a camera.
    pub fn of(&mut self, camera: &Camera) -> Arc<Rectifier> {
        let place = self.kept.iter().position(|(of, _)| of == camera);
        let found = place.map(|place| self.kept.remove(place));
        let (of, rectifier) = found.unwrap_or_else(|| (*camera, Arc::new(Rectifier::new(camera, self.scale))));
        self.kept.insert(0, (of, rectifier.clone()));
        self.kept.truncate(RECTIFIERS_KEPT);
        rectifier
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;
    use crate::geometry::Distortion;

    fn camera(distortion: Distortion) -> Camera {
        let pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
        Camera { pinhole, distortion, depth_units_per_metre: 5000.0 }
    }

    fn frame(depth: impl Fn(u32, u32) -> f32) -> Frame {
        let metres = (0..64 * 48).map(|i| depth(i % 64, i / 64)).collect();
        let color = RgbImage::from_fn(64, 48, |x, y| Rgb([x as u8 * 2, y as u8 * 2, 7]));
        let depth = Some(DepthImage { width: 64, height: 48, metres });
        Frame { index: 0, timestamp_s: 0.0, color, depth, right: None, mask: None }
    }

    #[test]
    fn an_ideal_camera_at_full_scale_is_left_as_it_is() {
        let frame = frame(|x, _| x as f32 * 0.01);
        let rectified = Rectifier::new(&camera(Distortion::default()), 1.0).rectify(&frame);
        assert_eq!(rectified.color, frame.color);
        assert_eq!(rectified.depth.unwrap(), frame.depth.unwrap());
    }

    #[test]
    fn halving_averages_colour_but_never_across_a_depth_edge() {
        let frame = frame(|x, _| if x < 33 { 1.0 } else { 3.0 });
        let rectified = Rectifier::new(&camera(Distortion::default()), 0.5).rectify(&frame);
        assert_eq!(rectified.color.get_pixel(3, 0).0[0], 13);
        assert!(rectified.depth.unwrap().metres.iter().all(|m| *m == 1.0 || *m == 3.0));
    }

    /// A pincushion's corners lie outside of the recorded image, a barrel's border too where the lens model folds back.
    #[test]
    fn pixels_beyond_the_recorded_image_are_not_valid() {
        let valid = |k1: f64, scale: f64| {
            let rectifier = Rectifier::new(&camera(Distortion { k1, ..Distortion::default() }), scale);
            let image = rectifier.rectify(&frame(|_, _| 1.0));
            let (width, height) = image.color.dimensions();
            let at = |x: u32, y: u32| {
                let i = (y * width + x) as usize;
                assert_eq!(image.is_valid(i), image.depth.as_ref().unwrap().metres[i] > 0.0);
                image.is_valid(i)
            };
            [at(0, 0), at(width - 1, height - 1), at(width / 2, 0), at(width / 2, height / 2)]
        };
        assert_eq!(valid(0.2, 1.0), [false, false, false, true]);
        assert_eq!(valid(0.2, 0.5), [false, false, true, true], "the first row's centres are further in");
        assert_eq!(valid(-0.2, 0.5), [true; 4]);
        assert_eq!(valid(-1.5, 1.0), [false, false, true, true]);
        assert!(Rectifier::new(&camera(Distortion::default()), 0.3).valid.is_none());
    }

    #[test]
    fn rectifiers_of_the_last_few_cameras_are_kept() {
        let cameras: Vec<Camera> =
            (0..8).map(|i| camera(Distortion { k1: 0.01 * f64::from(i), ..Distortion::default() })).collect();
        let mut rectifiers = Rectifiers::new(0.5);
        let first = rectifiers.of(&cameras[0]);
        assert!(cameras[1..4].iter().all(|camera| !Arc::ptr_eq(&first, &rectifiers.of(camera))));
        assert!(Arc::ptr_eq(&first, &rectifiers.of(&cameras[0])));
        cameras[4..].iter().for_each(|camera| drop(rectifiers.of(camera)));
        assert!(!Arc::ptr_eq(&first, &rectifiers.of(&cameras[0])), "it was let go");
        assert_eq!((rectifiers.kept.len(), Arc::strong_count(&first)), (RECTIFIERS_KEPT, 1));
    }

    /// A mapping pixel with one masked pixel below it is not valid, and has no depth.
    #[test]
    fn masked_pixels_are_not_valid() {
        let mask = GrayImage::from_fn(64, 48, |x, y| image::Luma([u8::from((x, y) != (10, 21))]));
        let masked = Frame { mask: Some(mask), ..frame(|_, _| 1.0) };
        let invalid = |k1: f64, scale: f64| {
            let image = Rectifier::new(&camera(Distortion { k1, ..Distortion::default() }), scale).rectify(&masked);
            let invalid = (0..image.color.width() * image.color.height()).filter(|&i| !image.is_valid(i as usize));
            let places: Vec<(u32, u32)> = invalid.map(|i| (i % image.color.width(), i / image.color.width())).collect();
            assert!(places.iter().all(|(x, y)| image.depth.as_ref().unwrap().at(*x, *y).is_none()));
            places
        };
        assert_eq!(invalid(0.0, 1.0), [(10, 21)]);
        assert_eq!(invalid(0.0, 0.5), [(5, 10)]);
        assert!(invalid(0.2, 1.0).contains(&(0, 0)), "what the camera did not record stays invalid");
        let all = Frame { mask: Some(GrayImage::from_pixel(64, 48, image::Luma([255]))), ..masked.clone() };
        assert!(Rectifier::new(&camera(Distortion::default()), 0.5).rectify(&all).valid.is_none());
        assert!(!masked.keeps(&Vector2::new(10.4, 20.6)) && masked.keeps(&Vector2::new(10.6, 20.6)));
    }

    #[test]
    fn a_distorted_ramp_becomes_straight() {
        let lens = Distortion { k1: -0.2, ..Distortion::default() };
        let camera = camera(lens);
        // Colour encodes the ideal column; the recorded image shows it through the lens.
        let mut frame = frame(|_, _| 0.0);
        frame.color = RgbImage::from_fn(64, 48, |x, y| {
            let ideal = camera.undistort_pixel(&Vector2::new(f64::from(x), f64::from(y)));
            Rgb([(ideal.x * 3.0).clamp(0.0, 255.0).round() as u8; 3])
        });
        let rectified = Rectifier::new(&camera, 1.0).rectify(&frame);
        for (x, y, pixel) in rectified.color.enumerate_pixels().filter(|(x, y, _)| (4..60).contains(x) && (4..44).contains(y)) {
            assert!((f64::from(pixel.0[0]) - f64::from(x) * 3.0).abs() <= 1.5, "at {x},{y}");
        }
    }
}
