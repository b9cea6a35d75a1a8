//! The tracker's messages to the mapper.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Keyframe, KeyframeId};
use crate::geometry::Se3;
use crate::sequence::KnownPoint;
use crate::splat::GaussianCloud;

/// One message from the tracker to the mapper, in the order of sending. The channel's end is the end of the sequence.
#[derive(Clone, Debug)]
pub enum MapperMessage {
    /// Scene points of the recording, before the first keyframe.
    Points(Vec<KnownPoint>),
    /// A map that others made, before the first keyframe.
    Map(InitialMap),
    /// A new keyframe with its image.
    Keyframe(Box<Keyframe>),
    /// New poses of earlier keyframes after bundle adjustment or a loop closure.
    PoseUpdate(Vec<PoseUpdate>),
    /// Keyframes of submaps that never joined the largest one, after the last frame.
    Remove(Vec<KeyframeId>),
}

/// The map that a run begins with.
#[derive(Clone, Debug)]
pub struct InitialMap {
    /// Its Gaussians, in the keyframes' world.
    pub cloud: Arc<GaussianCloud>,
    /// So many of them, the first ones, are rendered and never change.
    pub frozen: usize,
}

/// New pose of an earlier keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseUpdate {
    /// The keyframe.
    pub keyframe: KeyframeId,
    /// New pose, metres.
    pub world_from_camera: Se3,
    /// Factor by which lengths around the keyframe grow with this update; 1 for a rigid motion.
    pub scale: f64,
}

impl PoseUpdate {
    /// A rigid motion.
    pub fn rigid(keyframe: KeyframeId, world_from_camera: Se3) -> Self {
        Self { keyframe, world_from_camera, scale: 1.0 }
    }
}
