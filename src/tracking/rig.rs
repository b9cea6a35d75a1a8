//! The camera and the configuration that all stages share.

use crate::geometry::Pinhole;
use crate::tracking::TrackingConfig;
use crate::tracking::features::frame_features::Feature;
use crate::tracking::solvers::depth_bias::DepthBias;
use crate::tracking::solvers::pixel_noise::PixelNoise;
use crate::tracking::solvers::residual::Measurement;

/// The distortion-free camera of a recording, its tracking configuration, and what the recording has shown of its errors.
#[derive(Clone, Debug)]
pub struct Rig {
    pub pinhole: Pinhole,
    pub config: TrackingConfig,
    /// As the last bundle adjustment found it.
    pub depth_bias: DepthBias,
    /// As the frames so far show it.
    pub pixel_noise: PixelNoise,
    octave_scales: Vec<f64>,
}

impl Rig {
    /// A rig whose depth is not known to err.
    pub fn new(pinhole: Pinhole, config: TrackingConfig) -> Self {
        Self {
            pinhole,
            depth_bias: DepthBias::default(),
            pixel_noise: PixelNoise::new(config.pixel_sigma),
            octave_scales: (0..config.pyramid_levels).map(|octave| config.pyramid_scale.powi(octave as i32)).collect(),
            config,
        }
    }

    /// A feature's measurement, freed of the depth's bias, with weights from the noise model.
    pub fn measurement(&self, feature: &Feature) -> Measurement {
        self.biased_measurement(feature).without_bias(&self.pinhole, &self.depth_bias)
    }

    /// The same with depth as it was measured.
    pub fn biased_measurement(&self, feature: &Feature) -> Measurement {
        feature.measurement(self.pixel_sigma(feature.octave))
    }

    /// Standard deviation of a keypoint's coordinates at a pyramid octave, pixels of the finest.
    pub fn pixel_sigma(&self, octave: u8) -> f64 {
        self.pixel_noise.sigma() * self.octave_scale(octave)
    }

    /// Scale of a pyramid octave relative to the finest: `pyramid_scale` to the power of `octave`.
    pub fn octave_scale(&self, octave: u8) -> f64 {
        self.octave_scales[usize::from(octave)]
    }

    /// The finest octave of at least this scale; the coarsest if none is.
    pub fn octave_of_scale(&self, scale: f64) -> u8 {
        self.octave_scales.partition_point(|octave| *octave < scale).min(self.octave_scales.len() - 1) as u8
    }
}
