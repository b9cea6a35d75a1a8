//! The front end: from a frame's images to what the tracker needs of them. It knows no other frame, so that frames can be extracted ahead, in
//! parallel, in any order.

use std::sync::Arc;
use std::time::Instant;

use image::RgbImage;
use nalgebra::Vector2;
use pulp::{Arch, Simd};

use crate::geometry::Camera;
use crate::sequence::{DepthImage, Frame, Sensor};
use crate::tracking::features::dense_frame::{DenseFrame, DenseSampler};
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::features::orb::{Extractor, Keypoint};
use crate::tracking::features::stereo::disparities;
use crate::tracking::{TrackingConfig, TrackingError};

/// Nearest depth that a stereo pair measures, in baselines.
const NEAREST_BASELINES: f64 = 2.0;

/// Camera, sensor and ORB extractor.
#[derive(Debug)]
pub struct FrontEnd {
    camera: Camera,
    sensor: Sensor,
    config: TrackingConfig,
    extractor: Extractor,
    /// Of frames with depth images.
    sampler: Option<DenseSampler>,
}

/// A frame's features, and its pixels at low resolution where it has a depth image.
#[derive(Clone, Debug)]
pub struct ExtractedFrame {
    /// Of the frame in its sequence.
    pub(crate) index: usize,
    pub(crate) timestamp_s: f64,
    pub(crate) has_depth_image: bool,
    pub(crate) features: Arc<FrameFeatures>,
    pub(crate) dense: Option<Arc<DenseFrame>>,
    /// Time of the extraction, milliseconds.
    pub(crate) features_ms: f64,
}

impl ExtractedFrame {
    /// Seconds, by the clock of the recording.
    pub fn timestamp_s(&self) -> f64 {
        self.timestamp_s
    }
}

impl FrontEnd {
    /// A front end for one camera; the settings are checked by [`Tracker::new`](crate::tracking::Tracker::new).
    pub fn new(camera: Camera, sensor: Sensor, config: &TrackingConfig) -> Self {
        let features = config.features_kept(sensor.kind());
        Self {
            extractor: Extractor::new(camera.pinhole.width, camera.pinhole.height, features, config),
            sampler: (sensor == Sensor::Rgbd).then(|| DenseSampler::new(&camera)),
            config: config.clone(),
            camera,
            sensor,
        }
    }

    /// Extracts what the tracker needs of a frame.
    ///
    /// # Errors
    /// [`TrackingError::Size`] if an image's size is not the camera's, [`TrackingError::OpenCv`] if OpenCV fails.
    pub fn extract(&self, frame: &Frame) -> Result<ExtractedFrame, TrackingError> {
        let started = Instant::now();
        self.check(frame)?;
        let grey = luma(&frame.color);
        let features = Arc::new(FrameFeatures::new(self.features(frame, &grey)?, &self.camera.pinhole));
        let sampled = self.sampler.as_ref().zip(frame.depth.as_ref());
        Ok(ExtractedFrame {
            index: frame.index,
            timestamp_s: frame.timestamp_s,
            has_depth_image: frame.depth.is_some(),
            features,
            dense: sampled.map(|(sampler, depth)| Arc::new(sampler.sample(&grey, depth, &self.config))),
            features_ms: started.elapsed().as_secs_f64() * 1e3,
        })
    }

    fn check(&self, frame: &Frame) -> Result<(), TrackingError> {
        let (width, height) = (self.camera.pinhole.width, self.camera.pinhole.height);
        let size = |what, (found_width, found_height)| {
            let good = (found_width, found_height) == (width, height);
            let error = TrackingError::Size { frame: frame.index, what, width, height, found_width, found_height };
            if good { Ok(()) } else { Err(error) }
        };
        size("colour", frame.color.dimensions())?;
        frame.depth.as_ref().map_or(Ok(()), |depth| size("depth", (depth.width, depth.height)))
    }

    /// The features with depth from the depth image or the right image. `grey` is the frame's luma, row-major.
    fn features(&self, frame: &Frame, grey: &[u8]) -> Result<Vec<Feature>, TrackingError> {
        let (keypoints, depths) = match (self.sensor, &frame.right) {
            (Sensor::Stereo { baseline_metres }, Some(right)) => self.stereo_depths(grey, right.as_raw(), baseline_metres)?,
            _ => {
                let keypoints = self.extractor.extract(&self.extractor.pyramid(grey)?)?;
                let depth = |k: &Keypoint| depth_at(frame.depth.as_ref()?, &k.pixel, &self.config);
                let depths = keypoints.iter().map(|k| Some((depth(k)?, self.config.inverse_depth_sigma))).collect();
                (keypoints, depths)
            }
        };
        let feature = |(k, depth): (Keypoint, MeasuredDepth)| Feature {
            pixel: self.camera.undistort_pixel(&k.pixel),
            octave: k.octave,
            angle_rad: k.angle_rad,
            depth_metres: depth.map(|(metres, _)| metres),
            inverse_depth_sigma: depth.map_or(0.0, |(_, sigma)| sigma),
            descriptor: k.descriptor,
        };
        let kept = keypoints.into_iter().zip(depths).filter(|(k, _)| frame.keeps(&k.pixel));
        Ok(kept.map(feature).filter(|f| f.pixel.iter().all(|v| v.is_finite())).collect())
    }

    /// Keypoints of the left image with depths from the right one: depth = focal length · baseline / disparity.
    fn stereo_depths(
        &self,
        left: &[u8],
        right: &[u8],
        baseline_metres: f64,
    ) -> Result<(Vec<Keypoint>, Vec<MeasuredDepth>), TrackingError> {
        let (config, focal) = (&self.config, self.camera.pinhole.fx);
        let scale = focal * baseline_metres;
        let (left, right) = rayon::join(|| self.extractor.pyramid(left), || self.extractor.pyramid(right));
        let (left, right) = (left?, right?);
        let keypoints = self.extractor.extract(&left)?;
        let disparities = disparities(&keypoints, &left, &right, focal / NEAREST_BASELINES)?;
        let sigma = |k: &Keypoint| config.disparity_sigma * config.pyramid_scale.powi(k.octave.into()) / scale;
        let depths = keypoints.iter().zip(disparities).map(|(k, disparity)| disparity.map(|d| (scale / d, sigma(k)))).collect();
        Ok((keypoints, depths))
    }
}

/// Metres and the standard deviation of the inverse depth, 1/metres, where a depth was measured.
type MeasuredDepth = Option<(f64, f64)>;

/// Rec. 601 luma in integers, row-major.
#[pulp::with_simd(luma = Arch::new())]
#[inline(always)]
fn luma_with<S: Simd>(_: S, image: &RgbImage) -> Vec<u8> {
    let (pixels, _) = image.as_raw().as_chunks();
    let mut grey = vec![0; pixels.len()];
    for (grey, [r, g, b]) in grey.iter_mut().zip(pixels) {
        // The weights' sum is 256: 16 bits hold the largest value.
        *grey = ((u16::from(*r) * 77 + u16::from(*g) * 150 + u16::from(*b) * 29 + 128) >> 8) as u8;
    }
    grey
}

/// The depth at a recorded pixel, unless it is out of range, not finite, or on an edge.
fn depth_at(depth: &DepthImage, pixel: &Vector2<f64>, config: &TrackingConfig) -> Option<f64> {
    let (x, y) = (pixel.x.round(), pixel.y.round());
    if x < 0.0 || y < 0.0 || x >= f64::from(depth.width) || y >= f64::from(depth.height) {
        return None;
    }
    let (x, y) = (x as u32, y as u32);
    let centre = f64::from(depth.at(x, y)?);
    if !(centre >= config.min_depth_metres && centre <= config.max_depth_metres) {
        return None;
    }
    for v in y.saturating_sub(1)..=(y + 1).min(depth.height - 1) {
        for u in x.saturating_sub(1)..=(x + 1).min(depth.width - 1) {
            if depth.at(u, v).is_some_and(|d| (f64::from(d) - centre).abs() > config.depth_edge_ratio * centre) {
                return None;
            }
        }
    }
    Some(centre)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_is_the_weighted_mean_of_the_channels() {
        let colour = |i: u32| image::Rgb([(i * 37 % 256) as u8, (i * 91 % 256) as u8, (i * 53 % 256) as u8]);
        let mut picture = RgbImage::from_fn(37, 11, |x, y| colour(x + 37 * y));
        picture.put_pixel(36, 10, image::Rgb([255; 3]));
        let grey = luma(&picture);
        for (value, image::Rgb([r, g, b])) in grey.iter().zip(picture.pixels()) {
            let expected = 0.299 * f64::from(*r) + 0.587 * f64::from(*g) + 0.114 * f64::from(*b);
            assert!((f64::from(*value) - expected).abs() < 1.2, "{value} for {r} {g} {b}");
        }
        assert_eq!((grey.len(), grey[36 + 37 * 10]), (37 * 11, 255));
    }

    #[test]
    fn depth_on_an_edge_or_out_of_range_is_left_out() {
        let metres = (0..100).map(|i| if i % 10 < 5 { 1.0 } else { 2.0 }).collect();
        let mut depth = DepthImage { width: 10, height: 10, metres };
        depth.metres[3 * 10 + 1] = f32::NAN;
        let at = |x: f64, y: f64| depth_at(&depth, &Vector2::new(x, y), &TrackingConfig::default());
        assert_eq!(at(2.2, 6.0), Some(1.0));
        assert_eq!((at(4.0, 6.0), at(5.0, 6.0), at(7.0, 6.0)), (None, None, Some(2.0)));
        assert_eq!((at(1.0, 3.0), at(-3.0, 0.0), at(9.6, 2.0)), (None, None, None));
    }
}
