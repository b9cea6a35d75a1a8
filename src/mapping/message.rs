//! The tracker's messages to the mapper.

use super::{Keyframe, KeyframeId};
use crate::geometry::Se3;
use crate::sequence::KnownPoint;

/// One message from the tracker to the mapper, in the order of sending. The channel's end is the end of the sequence.
#[derive(Clone, Debug)]
pub enum MapperMessage {
    /// Scene points of the recording, before the first keyframe.
    Points(Vec<KnownPoint>),
    /// A new keyframe with its image.
    Keyframe(Box<Keyframe>),
    /// New `world_from_camera` of earlier keyframes after bundle adjustment or a loop closure.
    PoseUpdate(Vec<(KeyframeId, Se3)>),
}
