//! The camera and the configuration that all stages share.

use crate::geometry::Pinhole;
use crate::tracking::TrackingConfig;
use crate::tracking::features::frame_features::Feature;
use crate::tracking::solvers::depth_bias::DepthBias;
use crate::tracking::solvers::residual::Measurement;

/// The distortion-free camera of a recording, and its tracking configuration. Only the bias changes during a run.
#[derive(Clone, Debug)]
pub struct Rig {
    pub pinhole: Pinhole,
    pub config: TrackingConfig,
    /// As the last bundle adjustment found it.
    pub depth_bias: DepthBias,
}

impl Rig {
    /// A rig whose depth is not known to err.
    pub fn new(pinhole: Pinhole, config: TrackingConfig) -> Self {
        Self { pinhole, config, depth_bias: DepthBias::default() }
    }

    /// A feature's measurement, freed of the depth's bias, with weights from the noise model.
    pub fn measurement(&self, feature: &Feature) -> Measurement {
        feature.measurement(&self.config).without_bias(&self.pinhole, &self.depth_bias)
    }

    /// Scale of a pyramid octave relative to the finest: `pyramid_scale` to the power of `octave`.
    pub fn octave_scale(&self, octave: u8) -> f64 {
        self.config.pyramid_scale.powi(octave.into())
    }
}
