//! The camera and the configuration that all stages share.

use crate::geometry::Pinhole;
use crate::tracking::TrackingConfig;

/// The distortion-free camera of a recording, and its tracking configuration. Constant during a run.
#[derive(Clone, Debug)]
pub struct Rig {
    pub pinhole: Pinhole,
    pub config: TrackingConfig,
}

impl Rig {
    /// Scale of a pyramid octave relative to the finest: `pyramid_scale` to the power of `octave`.
    pub fn octave_scale(&self, octave: u8) -> f64 {
        self.config.pyramid_scale.powi(octave.into())
    }
}
