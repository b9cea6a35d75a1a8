//! How bright a camera shows a map: its automatic exposure and white balance.

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Natural logarithms of the gains of red, green and blue: a picture's colour is the map's times `exp` of these. All 0 by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposure(pub [f32; 3]);

impl Exposure {
    /// Factors from the map's colours to the picture's.
    pub fn gains(&self) -> Vec3 {
        Vec3::from(self.0.map(f32::exp))
    }

    /// The one a share of the way (0 to 1) to another.
    pub fn towards(&self, other: &Self, share: f32) -> Self {
        Self(std::array::from_fn(|k| self.0[k] + share * (other.0[k] - self.0[k])))
    }
}
