//! Real spherical harmonics up to degree 3, in the order and signs of the 3DGS file format (Kerbl et al. 2023; Sloan 2013).

use serde::{Deserialize, Serialize};

/// Coefficient of the constant band, `1 / (2√π)`.
pub const SH_C0: f32 = 0.282_094_8;

/// Degree of a map's view dependence, 0 to 3.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
pub struct ShDegree(u8);

impl ShDegree {
    /// Degrees 0 to 3.
    pub const ALL: [Self; 4] = [Self(0), Self(1), Self(2), Self(3)];

    /// The degree, if it is 0 to 3.
    pub fn new(degree: u8) -> Option<Self> {
        (degree <= 3).then_some(Self(degree))
    }

    /// The degree as a number, 0 to 3.
    pub fn get(self) -> u8 {
        self.0
    }

    /// Coefficients per colour channel: 1, 4, 9 or 16.
    pub fn coefficients(self) -> usize {
        (usize::from(self.0) + 1).pow(2)
    }
}

impl TryFrom<u8> for ShDegree {
    type Error = String;

    fn try_from(degree: u8) -> Result<Self, String> {
        Self::new(degree).ok_or_else(|| format!("a spherical-harmonics degree is 0, 1, 2 or 3, not {degree}"))
    }
}

impl From<ShDegree> for u8 {
    fn from(degree: ShDegree) -> u8 {
        degree.0
    }
}

/// The constant coefficient of a colour in [0, 1].
pub fn dc_from_color(color: glam::Vec3) -> glam::Vec3 {
    (color - 0.5) / SH_C0
}
