//! A large map in parts: regions of space that are refined apart from each other, and what each camera sees of them.
//!
//! As in VastGaussian (Lin et al. 2024) and Hierarchical 3DGS (Kerbl et al. 2024), a part is refined with its surroundings: its halo is refined
//! too and left out of the result, and what its cameras see beyond is rendered and frozen.

mod cells;
mod coverage;
mod visibility;

use std::fmt::{self, Display};

use glam::Vec3;
use serde::{Deserialize, Serialize};

pub use cells::cells;
pub use coverage::{BLOCK, Coverage};
pub use visibility::{RegionView, cameras_that_see};

/// An axis-aligned box of the map's world, and how far around it the map is refined with it; metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Least coordinates, which belong to the region.
    pub low: [f32; 3],
    /// Largest coordinates, which belong to its neighbours.
    pub high: [f32; 3],
    /// Width of its surroundings that are refined, too.
    pub halo: f32,
}

/// Beyond all Gaussians, metres: a bound there is none.
const FAR: f32 = 1e6;

/// Where a Gaussian lies, for a region.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Within the region.
    Core,
    /// Outside, but within the halo.
    Halo,
    /// Farther away.
    Beyond,
}

impl Region {
    /// Where a centre lies.
    pub fn place(&self, mean: Vec3) -> Place {
        let (low, high) = (Vec3::from(self.low), Vec3::from(self.high));
        let within = |margin: f32| mean.cmpge(low - margin).all() && mean.cmplt(high + margin).all();
        match (within(0.0), within(self.halo)) {
            (true, _) => Place::Core,
            (false, true) => Place::Halo,
            (false, false) => Place::Beyond,
        }
    }

    /// Whether a sphere reaches through the region's border, from inside or outside.
    pub fn border_crosses(&self, center: Vec3, radius: f32) -> bool {
        let (low, high) = (Vec3::from(self.low), Vec3::from(self.high));
        let outside = (low - center).max(center - high).max(Vec3::ZERO).length();
        let inside = (center - low).min(high - center).min_element();
        if outside > 0.0 { outside < radius } else { inside < radius }
    }

    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        let finite = self.low.iter().chain(&self.high).all(|v| v.is_finite());
        if !finite || self.low.iter().zip(&self.high).any(|(low, high)| low >= high) {
            return Err("region.low must lie below region.high, and both must be finite".into());
        }
        if self.halo.is_finite() && self.halo >= 0.0 { Ok(()) } else { Err("region.halo must be zero or more".into()) }
    }
}

impl Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let end = |value: f32| if value.abs() < FAR { format!("{value:.1}") } else { String::new() };
        let [x, y, z] = [0, 1, 2].map(|axis| format!("{}..{}", end(self.low[axis]), end(self.high[axis])));
        write!(f, "x {x}, y {y}, z {z}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_place_is_found() {
        let region = Region { low: [0.0, -1.0, 0.0], high: [2.0, 1.0, 4.0], halo: 0.5 };
        assert_eq!(region.place(Vec3::new(0.0, -1.0, 0.0)), Place::Core);
        assert_eq!(region.place(Vec3::new(2.0, 0.0, 1.0)), Place::Halo);
        assert_eq!(region.place(Vec3::new(1.0, 0.0, 4.6)), Place::Beyond);
        for (center, radius, crosses) in
            [([0.25, 0.0, 2.0], 0.2, false), ([0.25, 0.0, 2.0], 0.3, true), ([5.0, 0.0, 8.0], 4.9, false)]
        {
            assert_eq!(region.border_crosses(Vec3::from(center), radius), crosses);
        }
        assert_eq!(Region { high: [FAR, 1.0, 4.0], ..region }.to_string(), "x 0.0.., y -1.0..1.0, z 0.0..4.0");
        assert!(region.border_crosses(Vec3::new(5.0, 0.0, 8.0), 5.1) && region.validate().is_ok());
        for wrong in [
            Region { high: [2.0, -1.0, 4.0], ..region },
            Region { low: [f32::NAN; 3], ..region },
            Region { halo: -1.0, ..region },
        ] {
            assert!(wrong.validate().is_err());
        }
    }
}
