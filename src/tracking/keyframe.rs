//! When a frame becomes a keyframe: by how little of the reference keyframe is still seen, and by how far the camera has moved.

use super::TrackingConfig;
use super::frame_features::FrameFeatures;
use super::localise::Localised;
use super::map::Map;

/// Landmarks that only one keyframe has seen count towards the reference keyframe's only while the map is this young.
const YOUNG_MAP: usize = 3;
/// With fewer tracked points within depth than this, and more new ones than that, the view has changed enough.
const FEW_TRACKED: usize = 100;
const MANY_NEW: usize = 100;

/// Whether a tracked frame should become a keyframe; `reference` is the keyframe that shares most landmarks with it.
pub fn is_due(map: &Map, frame: &FrameFeatures, found: &Localised, reference: usize, config: &TrackingConfig) -> bool {
    let view = &map.keyframes[reference];
    let sightings = if map.keyframes.len() < YOUNG_MAP { 1 } else { 2 };
    let expected = view.landmark_count(map, sightings);
    let overlap_lost = (found.inliers as f64) < config.keyframe_overlap * expected as f64;

    let camera_from_reference = found.camera_from_world * view.camera_from_world.inverse();
    let depth = frame.median_depth().or_else(|| view.features.median_depth()).unwrap_or(1.0);
    let moved = camera_from_reference.translation.vector.norm() > config.keyframe_translation * depth;
    let turned = camera_from_reference.rotation.angle() > config.keyframe_rotation_rad;

    let with_depth = |tracked: bool| {
        let pairs = frame.features.iter().zip(&found.landmarks);
        pairs.filter(|(f, l)| f.depth_metres.is_some() && l.is_some() == tracked).count()
    };
    let new_view = with_depth(true) < FEW_TRACKED && with_depth(false) > MANY_NEW;
    overlap_lost || moved || turned || new_view
}
