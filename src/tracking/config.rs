//! What can be set about tracking. The defaults were chosen on scenes in general; lengths are metres, angles radians.

use serde::{Deserialize, Serialize};

use crate::sequence::SensorKind;

const FEATURES_RGBD: usize = 2000;
const FEATURES_MONO: usize = 1500;
const FEATURES_STEREO: usize = 1500;

/// Settings of the tracker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackingConfig {
    /// Features kept per frame, over all pyramid levels; by default 2000 with depth images, and 1500 of a single camera or a stereo pair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub features: Option<usize>,
    /// Levels of the image pyramid.
    pub pyramid_levels: usize,
    /// Size ratio between neighbouring pyramid levels, above 1.
    pub pyramid_scale: f64,
    /// FAST threshold in grey levels.
    pub fast_threshold: u8,
    /// FAST threshold where the image has no corner at `fast_threshold`.
    pub fast_threshold_low_texture: u8,
    /// Least valid depth.
    pub min_depth_metres: f64,
    /// Largest valid depth.
    pub max_depth_metres: f64,
    /// Standard deviation of a keypoint's position at the finest pyramid level, pixels. Coarser levels scale it.
    pub pixel_sigma: f64,
    /// Whether residuals may lower it, down to a half.
    pub pixel_noise: bool,
    /// Standard deviation of measured inverse depth, 1/metres. A structured-light sensor measures disparity with constant noise,
    /// so its depth noise grows as `inverse_depth_sigma * depth²`.
    pub inverse_depth_sigma: f64,
    /// Whether a systematic error of measured depth is estimated: a tilt of a depth image's inverse depth over the image, or an offset of disparities.
    pub depth_bias: bool,
    /// Standard deviation of a stereo disparity at the finest pyramid level, pixels. Coarser levels scale it.
    pub disparity_sigma: f64,
    /// A depth whose 3x3 neighbourhood spans more than this share of it lies on an edge and is dropped.
    pub depth_edge_ratio: f64,
    /// Landmarks that the first frame must give before there is a map.
    pub min_initial_landmarks: usize,
    /// Landmarks that must agree with a pose before it is trusted.
    pub min_inliers: usize,
    /// As `min_inliers`, for a pose found again after being lost.
    pub min_relocalisation_inliers: usize,
    /// A keyframe is due when fewer than this share of the reference keyframe's landmarks are still tracked (and the camera has moved
    /// a quarter of what the next two ask for).
    pub keyframe_overlap: f64,
    /// A keyframe is due after moving this far from the reference keyframe, as a share of the scene's median depth.
    pub keyframe_translation: f64,
    /// A keyframe is due after turning this far from the reference keyframe.
    pub keyframe_rotation_rad: f64,
    /// Image-only keyframes a second, at most: frames between keyframes whose images the map learns from. 0: none.
    pub images_per_second: f64,
    /// Keyframes whose poses one bundle adjustment may move.
    pub window_keyframes: usize,
    /// Levenberg-Marquardt steps in each of the two rounds of one bundle adjustment. 0 turns it off.
    pub bundle_iterations: usize,
    /// Whether keyframes that show nothing of their own are given up.
    pub keyframe_culling: bool,
    /// Host memory for keyframes and landmarks, bytes; beyond it keyframes are given up where many see the same.
    pub max_host_bytes: u64,
    /// Whether drift is taken out where a known place is seen again.
    pub loop_closing: bool,
}

impl Default for TrackingConfig {
    fn default() -> Self {
        Self {
            features: None,
            pyramid_levels: 8,
            pyramid_scale: 1.2,
            fast_threshold: 20,
            fast_threshold_low_texture: 7,
            min_depth_metres: 0.2,
            max_depth_metres: 6.0,
            pixel_sigma: 1.0,
            pixel_noise: true,
            inverse_depth_sigma: 0.025,
            depth_bias: true,
            disparity_sigma: 1.4,
            depth_edge_ratio: 0.05,
            min_initial_landmarks: 50,
            min_inliers: 20,
            min_relocalisation_inliers: 30,
            keyframe_overlap: 0.8,
            keyframe_translation: 0.06,
            keyframe_rotation_rad: 0.12,
            images_per_second: 10.0,
            window_keyframes: 24,
            bundle_iterations: 5,
            keyframe_culling: true,
            max_host_bytes: 1 << 30,
            loop_closing: true,
        }
    }
}

impl TrackingConfig {
    /// Features kept per frame of a sensor.
    pub fn features_kept(&self, sensor: SensorKind) -> usize {
        self.features.unwrap_or(match sensor {
            SensorKind::Rgbd => FEATURES_RGBD,
            SensorKind::Mono => FEATURES_MONO,
            SensorKind::Stereo => FEATURES_STEREO,
        })
    }

    /// Checks every value; the message names the field and what it may be.
    ///
    /// # Errors
    /// The key that is out of range, and its range.
    pub fn validate(&self) -> Result<(), String> {
        let count = |name: &str, value: usize, low: usize, high: usize| {
            let good = (low..=high).contains(&value);
            if good { Ok(()) } else { Err(format!("tracking.{name} is {value}; it must be from {low} to {high}")) }
        };
        let number = |name: &str, value: f64, low: f64, high: f64| {
            // NaN fails.
            let good = value > low && value <= high;
            if good { Ok(()) } else { Err(format!("tracking.{name} is {value}; it must be above {low} and at most {high}")) }
        };
        let fewest = self.features_kept(SensorKind::Stereo);
        count("features", fewest, 100, 20_000)?;
        count("pyramid_levels", self.pyramid_levels, 1, 16)?;
        number("pyramid_scale", self.pyramid_scale, 1.01, 2.0)?;
        count("fast_threshold", self.fast_threshold.into(), 1, 200)?;
        count("fast_threshold_low_texture", self.fast_threshold_low_texture.into(), 1, self.fast_threshold.into())?;
        number("min_depth_metres", self.min_depth_metres, 0.0, 1e3)?;
        number("max_depth_metres", self.max_depth_metres, self.min_depth_metres, 1e4)?;
        number("pixel_sigma", self.pixel_sigma, 0.0, 100.0)?;
        number("inverse_depth_sigma", self.inverse_depth_sigma, 0.0, 100.0)?;
        number("disparity_sigma", self.disparity_sigma, 0.0, 100.0)?;
        number("depth_edge_ratio", self.depth_edge_ratio, 0.0, 100.0)?;
        count("min_initial_landmarks", self.min_initial_landmarks, 10, fewest)?;
        count("min_inliers", self.min_inliers, 6, fewest)?;
        count("min_relocalisation_inliers", self.min_relocalisation_inliers, self.min_inliers, fewest)?;
        number("keyframe_overlap", self.keyframe_overlap, 0.0, 1.0)?;
        number("keyframe_translation", self.keyframe_translation, 0.0, 100.0)?;
        number("keyframe_rotation_rad", self.keyframe_rotation_rad, 0.0, std::f64::consts::PI)?;
        if !(0.0..=1e3).contains(&self.images_per_second) {
            return Err(format!("tracking.images_per_second is {}; it must be from 0 to 1000", self.images_per_second));
        }
        count("window_keyframes", self.window_keyframes, 2, 50)?;
        count("bundle_iterations", self.bundle_iterations, 0, 100)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_nonsense_is_refused_by_name() {
        assert_eq!(TrackingConfig::default().validate(), Ok(()));
        let nan = TrackingConfig { pixel_sigma: f64::NAN, ..Default::default() };
        assert!(nan.validate().unwrap_err().contains("pixel_sigma"));
        let flat = TrackingConfig { pyramid_scale: 1.0, ..Default::default() };
        assert!(flat.validate().unwrap_err().contains("pyramid_scale"));
        assert!(toml::from_str::<TrackingConfig>("featurs = 3").is_err());
    }
}
