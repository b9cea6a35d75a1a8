//! A keyframe as the mapper receives and keeps it.

use crate::geometry::Se3;
use crate::gpu::{Gpu, GpuError};
use crate::optimise::TargetImage;
use crate::sequence::RectifiedImage;
use crate::splat::ViewCamera;

/// The tracker's number of a keyframe.
pub type KeyframeId = usize;

/// What arrives.
#[derive(Clone, Debug)]
pub struct Keyframe {
    pub id: KeyframeId,
    pub world_from_camera: Se3,
    pub image: RectifiedImage,
    /// Earlier keyframes that see the same landmarks, strongest first.
    pub covisible: Vec<KeyframeId>,
}

/// What is kept: the image only where the optimiser needs it.
#[derive(Debug)]
pub(super) struct MappedKeyframe {
    pub id: KeyframeId,
    pub camera: ViewCamera,
    pub target: TargetImage,
    pub covisible: Vec<KeyframeId>,
}

impl MappedKeyframe {
    pub fn new(gpu: &Gpu, keyframe: &Keyframe) -> Result<Self, GpuError> {
        let depth = keyframe.image.depth.as_ref().map(|d| d.metres.as_slice());
        Ok(Self {
            id: keyframe.id,
            camera: ViewCamera { pinhole: keyframe.image.pinhole, camera_from_world: keyframe.world_from_camera.inverse() },
            target: TargetImage::new(gpu, &keyframe.image.color, depth)?,
            covisible: keyframe.covisible.clone(),
        })
    }
}
