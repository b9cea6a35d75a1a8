//! Keyframes of the sparse map.

use std::sync::Arc;

use nalgebra::Point3;

use crate::geometry::Se3;
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::map::sparse_map::Map;
use crate::tracking::solvers::relative_pose::RelativePose;

#[derive(Clone, Debug)]
pub struct Keyframe {
    /// The first keyframe of its submap. Submaps have no landmark in common and no known relative pose.
    pub root: usize,
    /// The living keyframe that it goes with, once it has been culled.
    pub parent: Option<usize>,
    pub frame_index: usize,
    pub timestamp_s: f64,
    pub camera_from_world: Se3,
    /// Metres in the unit of the lengths that are kept relative to this keyframe; closed loops without a known scale change it.
    pub unit: f64,
    /// The way of the camera until here.
    pub travelled: Travelled,
    /// Older keyframes that share most landmarks with it and how many, strongest first, as of its last bundle adjustment.
    pub links: Vec<(usize, usize)>,
    /// Keyframes that share most landmarks with it, older and newer ones, strongest first, as of its last bundle adjustment; before that, of its creation.
    pub neighbours: Vec<usize>,
    pub features: Arc<FrameFeatures>,
    /// Its pixels: where landmarks are few, and of the first in a submap, if there is depth.
    pub dense: Option<Arc<DenseFrame>>,
    /// Its pose relative to older keyframes by all pixels, where landmarks are few; poses are named by keyframe.
    pub relative_poses: Vec<RelativePose>,
    /// The landmark that each feature shows.
    pub landmarks: Vec<Option<usize>>,
}

/// Length of a way, and the sum of its turns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Travelled {
    pub metres: f64,
    pub radians: f64,
}

impl Keyframe {
    /// A keyframe without landmarks, in the first submap.
    pub fn new(frame_index: usize, timestamp_s: f64, camera_from_world: Se3, features: Arc<FrameFeatures>) -> Self {
        Self {
            root: 0,
            parent: None,
            frame_index,
            timestamp_s,
            camera_from_world,
            unit: 1.0,
            travelled: Travelled::default(),
            links: Vec::new(),
            neighbours: Vec::new(),
            landmarks: vec![None; features.len()],
            features,
            dense: None,
            relative_poses: Vec::new(),
        }
    }

    /// The camera's centre in the world, metres.
    pub fn centre(&self) -> Point3<f64> {
        self.camera_from_world.inverse_transform_point(&Point3::origin())
    }

    /// How many landmarks it sees that at least `observations` keyframes see.
    pub fn landmark_count(&self, map: &Map, observations: usize) -> usize {
        self.landmarks.iter().flatten().filter(|l| map.landmarks[**l].observations.len() >= observations).count()
    }

    /// camera_from_world of a camera whose pose relative to this keyframe is in this keyframe's unit of length.
    pub fn carry(&self, camera_from_keyframe: &Se3) -> Se3 {
        in_metres(camera_from_keyframe, self.unit) * self.camera_from_world
    }

    /// The inverse of [`Self::carry`].
    pub fn relative(&self, camera_from_world: &Se3) -> Se3 {
        in_metres(&(camera_from_world * self.camera_from_world.inverse()), 1.0 / self.unit)
    }
}

fn in_metres(pose: &Se3, unit: f64) -> Se3 {
    let mut scaled = *pose;
    scaled.translation.vector *= unit;
    scaled
}
