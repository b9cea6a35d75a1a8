//! A keyframe's exposure against the map's, which began as that of the first keyframe.
//!
//! It is measured when the keyframe arrives, on the render that insertion needs as well: the median ratio of image and render over the
//! pixels that both show well, in each channel. Photos arrive before there is a map, so the final refinement measures them. The loss
//! compares the map with corrected images.

use serde::{Deserialize, Serialize};

use crate::optimise::{Pixels, SampledPixel};
use crate::sequence::RectifiedImage;
use crate::splat::Exposure;

/// Whether, and how firmly, exposures are corrected.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExposureConfig {
    /// Measure each keyframe's exposure and white balance, and let the map learn from images without them.
    pub enabled: bool,
    /// Weight of the last keyframe's exposure against what is measured, as a share of the image's pixels.
    pub prior_share: f32,
    /// Share of each log gain that is given up again: what lasts becomes the map's own, and errors do not add up from keyframe to
    /// keyframe (lenses darken corners, so that what comes into view from there seems to brighten all the time).
    pub pull: f32,
    /// Largest change of a channel's log gain from one keyframe to the next; more is taken for something else.
    pub max_change: f32,
    /// Measurements of all keyframes' exposures during the first half of the final refinement. The map's own is then their mean.
    pub refinements: usize,
    /// Of image-only keyframes in a row, one in so many is measured; the exposures of the others lie between.
    pub measured_every: usize,
}

impl Default for ExposureConfig {
    fn default() -> Self {
        Self { enabled: true, prior_share: 0.1, pull: 0.5, max_change: 0.7, refinements: 0, measured_every: 1 }
    }
}

impl ExposureConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        let positive = |v: f32| v.is_finite() && v > 0.0;
        if !(positive(self.prior_share) && positive(self.max_change)) {
            return Err("prior_share and max_change must be positive".into());
        }
        if self.measured_every == 0 {
            return Err("measured_every must be positive".into());
        }
        if (0.0..1.0).contains(&self.pull) { Ok(()) } else { Err("pull must lie between 0 and 1".into()) }
    }
}

/// Pixels that the map covers less than this say nothing.
const MIN_ALPHA: f32 = 0.95;
/// Nor do those that are nearly black or nearly saturated in the image or the render.
const WELL_EXPOSED: std::ops::Range<f32> = 0.08..0.92;

/// The exposure of an image of which the map shows `samples`; `last` is that of the keyframe before. `recorded` has the image's pixels, 0 to
/// 255, and `None` where the camera recorded nothing.
pub(super) fn measure(
    recorded: impl Fn(usize) -> Option<[u8; 3]>,
    samples: &[SampledPixel],
    last: &Exposure,
    config: &ExposureConfig,
) -> Exposure {
    let covered = samples.iter().filter(|sample| sample.alpha >= MIN_ALPHA);
    let covered: Vec<(&SampledPixel, [u8; 3])> = covered.filter_map(|sample| Some((sample, recorded(sample.pixel)?))).collect();
    let channel = |k: usize| {
        let ratio = |&(sample, pixel): &(&SampledPixel, [u8; 3])| {
            let recorded = f32::from(pixel[k]) / 255.0;
            let shown = sample.color[k];
            (WELL_EXPOSED.contains(&recorded) && WELL_EXPOSED.contains(&shown)).then(|| recorded / shown)
        };
        let mut ratios: Vec<f32> = covered.iter().filter_map(ratio).collect();
        let count = ratios.len();
        if count == 0 {
            return last.0[k];
        }
        let (_, median, _) = ratios.select_nth_unstable_by(count / 2, f32::total_cmp);
        let trust = count as f32 / (count as f32 + config.prior_share * samples.len() as f32);
        let change = median.ln() - last.0[k];
        let found = if change.abs() <= config.max_change { last.0[k] + trust * change } else { last.0[k] };
        (1.0 - config.pull) * found
    };
    Exposure([channel(0), channel(1), channel(2)])
}

/// The pixels of an image, see [`measure`].
pub(super) fn recorded(image: &RectifiedImage) -> impl Fn(usize) -> Option<[u8; 3]> {
    |i| image.is_valid(i).then(|| std::array::from_fn(|k| image.color.as_raw()[3 * i + k]))
}

/// The same of pixels as the GPU has them.
pub(super) fn recorded_pixels(pixels: &Pixels) -> impl Fn(usize) -> Option<[u8; 3]> {
    |i| {
        let [r, g, b, a] = pixels.color[i].to_le_bytes();
        (a > 0).then_some([r, g, b])
    }
}

/// Makes the map's exposure the mean of these.
pub(super) fn center(exposures: &mut [Exposure]) {
    let count = exposures.len().max(1) as f32;
    let mean: [f32; 3] = std::array::from_fn(|k| exposures.iter().map(|exposure| exposure.0[k]).sum::<f32>() / count);
    exposures.iter_mut().for_each(|exposure| (0..3).for_each(|k| exposure.0[k] -= mean[k]));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pinhole;
    use image::{Rgb, RgbImage};

    /// A picture of some colours, and a render of it by a map of another exposure, half of which is missing.
    fn pair(gains: [f32; 3]) -> (RectifiedImage, Vec<SampledPixel>) {
        let shown = |x: u32, y: u32, k: usize| 0.2 + 0.5 * (((x * 7 + y * 13 + k as u32 * 5) % 32) as f32 / 32.0);
        let color =
            RgbImage::from_fn(32, 24, |x, y| Rgb(std::array::from_fn(|k| (shown(x, y, k) * gains[k] * 255.0).round() as u8)));
        let pinhole = Pinhole { fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5, width: 32, height: 24 };
        let sample = |i: u32| SampledPixel {
            pixel: i as usize,
            color: [0, 1, 2].map(|k| shown(i % 32, i / 32, k)),
            alpha: if i % 32 < 16 { 1.0 } else { 0.1 },
        };
        let rendered = (0..32 * 24).map(sample).collect();
        (RectifiedImage { pinhole, color, depth: None, valid: None }, rendered)
    }

    #[test]
    fn the_gains_are_found_and_taken_out() {
        let gains = [1.2, 1.0, 0.85];
        let (image, rendered) = pair(gains);
        let config = ExposureConfig { prior_share: 1e-6, pull: 0.0, ..ExposureConfig::default() };
        let exposure = measure(recorded(&image), &rendered, &Exposure::default(), &config);
        assert!((exposure.gains() - glam::Vec3::from(gains)).abs().max_element() < 0.01, "{exposure:?}");
    }

    #[test]
    fn pixels_that_were_not_recorded_say_nothing() {
        let (mut image, rendered) = pair([1.2; 3]);
        let config = ExposureConfig { prior_share: 1e-6, pull: 0.0, ..ExposureConfig::default() };
        let expected = measure(recorded(&image), &rendered, &Exposure::default(), &config);
        image.valid = Some((0..32 * 24).map(|i| i % 32 < 12).collect());
        (0..32 * 24).filter(|i| i % 32 >= 12).for_each(|i| image.color.put_pixel(i % 32, i / 32, Rgb([100; 3])));
        let found = measure(recorded(&image), &rendered, &Exposure::default(), &config);
        assert!((found.gains() - expected.gains()).abs().max_element() < 0.01, "{found:?} {expected:?}");
    }

    #[test]
    fn what_little_is_seen_moves_it_little_and_a_leap_not_at_all() {
        let (image, mut rendered) = pair([1.2; 3]);
        let config = ExposureConfig { pull: 0.0, ..ExposureConfig::default() };
        let last = Exposure([0.1; 3]);
        let whole = measure(recorded(&image), &rendered, &last, &config);
        rendered.iter_mut().filter(|sample| !sample.pixel.is_multiple_of(32)).for_each(|sample| sample.alpha = 0.0);
        let little = measure(recorded(&image), &rendered, &last, &config);
        assert!((0..3).all(|k| last.0[k] < little.0[k] && little.0[k] < whole.0[k]), "{little:?} {whole:?}");
        rendered.iter_mut().for_each(|sample| sample.alpha = 0.0);
        assert_eq!(measure(recorded(&image), &rendered, &last, &config), last);
        let (dark, rendered) = pair([0.45; 3]);
        assert_eq!(measure(recorded(&dark), &rendered, &last, &config), last);
    }

    #[test]
    fn the_maps_exposure_is_the_mean() {
        let mut exposures = [Exposure([0.1, 0.2, 0.0]), Exposure([0.3, -0.2, 0.0])];
        center(&mut exposures);
        let expected = [[-0.1, 0.2, 0.0], [0.1, -0.2, 0.0]];
        assert!(exposures.iter().zip(expected).all(|(e, x)| (0..3).all(|k| (e.0[k] - x[k]).abs() < 1e-6)), "{exposures:?}");
    }

    #[test]
    fn pixels_of_the_gpu_are_those_of_the_image() {
        let (mut image, _) = pair([1.0; 3]);
        image.valid = Some((0..32 * 24).map(|i| i != 5).collect());
        let alpha = |i: u32| if i == 5 { 0 } else { 255 };
        let pack = |i: u32| {
            let [r, g, b] = image.color.get_pixel(i % 32, i / 32).0;
            if alpha(i) == 0 { 0 } else { u32::from_le_bytes([r, g, b, 255]) }
        };
        let pixels = Pixels { color: (0..32 * 24).map(pack).collect(), depth_metres: Vec::new() };
        assert!((0..32 * 24).all(|i| recorded(&image)(i) == recorded_pixels(&pixels)(i)));
        assert_eq!(recorded(&image)(5), None);
    }
}
