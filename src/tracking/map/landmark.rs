//! Landmarks of the sparse map.

use nalgebra::{Point3, Vector3};

use crate::tracking::features::descriptor::Descriptor;

/// Feature `feature` of keyframe `keyframe` shows a landmark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observation {
    pub keyframe: usize,
    pub feature: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LandmarkState {
    Alive,
    Removed,
    /// It turned out to be another landmark.
    MergedInto(usize),
}

/// A landmark. It hangs on its anchor, the keyframe that has seen it first of those that see it: where the anchor moves, it moves.
#[derive(Clone, Debug)]
pub struct Landmark {
    pub anchor: usize,
    /// In the anchor's camera, in the anchor's unit of length.
    pub in_anchor: Point3<f64>,
    pub descriptor: Descriptor,
    /// Mean direction from the cameras to it in the anchor's camera, unit length.
    pub view_direction: Vector3<f64>,
    /// Nearest and furthest distance at which the pyramid shows it as it was seen, in the anchor's unit of length.
    pub range: (f64, f64),
    /// At most one per keyframe, in order of arrival.
    pub observations: Vec<Observation>,
    /// Keyframe that made it.
    pub first_keyframe: usize,
    /// Frames in which it should have been seen, and was.
    pub observable: u32,
    pub observed: u32,
    pub state: LandmarkState,
}

impl Landmark {
    pub fn seen_by(&self, keyframe: usize) -> bool {
        self.observations.iter().any(|s| s.keyframe == keyframe)
    }
}
