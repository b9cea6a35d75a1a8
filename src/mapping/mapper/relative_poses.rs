//! Refined poses of the window's keyframes relative to one another, for the tracker.

use crate::mapping::keyframe::MappedKeyframe;
use crate::mapping::{KeyframeId, RefinePosesConfig, RefinedPair};

/// The window's keyframes, each relative to the one of the window with which it shares most, where both have been refined.
pub(super) fn refined(keyframes: &[MappedKeyframe], window: &[usize], config: &RefinePosesConfig) -> Vec<RefinedPair> {
    // The first keyframe is the world, and right by definition.
    let refined = |k: usize| k == 0 || keyframes[k].refinement.is_informative();
    let partner = |k: usize| {
        let of_window = |id: &KeyframeId| window.iter().copied().find(|w| keyframes[*w].id == *id);
        keyframes[k].covisible.iter().filter_map(of_window).find(|w| refined(*w))
    };
    let pair = |(k, other): (usize, usize)| {
        let (keyframe, relative) = (&keyframes[k], &keyframes[other]);
        let sigma_rotation_rad = config.sigma_pixels / keyframe.camera.pinhole.fx;
        RefinedPair {
            keyframe: keyframe.id,
            relative_to: relative.id,
            keyframe_from_relative: keyframe.camera.camera_from_world * relative.camera.camera_from_world.inverse(),
            sigma_translation_metres: sigma_rotation_rad * keyframe.depth_metres,
            sigma_rotation_rad,
        }
    };
    window.iter().filter(|k| refined(**k)).filter_map(|k| Some((*k, partner(*k)?))).map(pair).collect()
}
