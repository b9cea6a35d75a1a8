//! When a frame becomes a keyframe: by how little of the reference keyframe is still seen, and by how far the camera has moved.

use crate::geometry::Se3;
use crate::tracking::TrackingConfig;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::localisation::localise::Localised;
use crate::tracking::map::sparse_map::Map;

/// Landmarks that only one keyframe has seen count towards the reference keyframe's only while the map is this young.
const YOUNG_MAP: usize = 3;
/// With fewer tracked points within depth than this, and more new ones than that, the view has changed enough.
const FEW_TRACKED: usize = 100;
const MANY_NEW: usize = 100;
/// Share of the motion thresholds that the camera must have moved before a smaller overlap counts: a frame that is only blurred loses
/// landmarks too, and keyframes from one place hold the map by nothing.
const LEAST_MOTION: f64 = 0.25;
/// Timestamps scatter: share of the interval between image-only keyframes after which the next is due,
const IMAGE_INTERVAL_SHARE: f64 = 0.9;
/// if the camera has moved by this share of what a keyframe needs.
const LEAST_IMAGE_MOTION: f64 = 0.02;
/// Below this overlap nearly any motion is enough. A camera at rest needs no keyframes, however little it sees.
const LOW_OVERLAP: f64 = 0.25;
const LEAST_MOTION_AT_LOW_OVERLAP: f64 = 0.05;

/// Whether a tracked frame should become a keyframe; `reference` is the keyframe that shares most landmarks with it.
pub fn is_due(map: &Map, frame: &FrameFeatures, found: &Localised, reference: usize, config: &TrackingConfig) -> bool {
    let view = &map.keyframes[reference];
    // The newest submap, in which all this happens, has all keyframes since its first.
    let observations = if map.keyframes.len() - view.root < YOUNG_MAP { 1 } else { 2 };
    let expected = view.landmark_count(map, observations);
    let overlap = found.inliers as f64 / expected.max(1) as f64;

    let motion = motion(map, frame, [&view.camera_from_world, &found.camera_from_world], reference, config);

    let with_depth = |tracked: bool| {
        let pairs = frame.features.iter().zip(&found.landmarks);
        pairs.filter(|(f, l)| f.depth_metres.is_some() && l.is_some() == tracked).count()
    };
    let new_view = with_depth(true) < FEW_TRACKED && with_depth(false) > MANY_NEW;
    let changed = overlap < config.keyframe_overlap || new_view;
    motion > 1.0 || (overlap < LOW_OVERLAP && motion > LEAST_MOTION_AT_LOW_OVERLAP) || (changed && motion > LEAST_MOTION)
}

/// Whether a frame that is no keyframe is worth an image-only one: so many seconds after the last keyframe of either kind, after so much motion, as a
/// share of what a keyframe needs.
pub fn is_image_due(since_s: f64, motion: f64, config: &TrackingConfig) -> bool {
    since_s.abs() * config.images_per_second >= IMAGE_INTERVAL_SHARE && motion >= LEAST_IMAGE_MOTION
}

/// How far the camera has moved or turned between two poses (camera_from_world), as a share of what a keyframe needs. Where the frame has no depth,
/// `reference` has the scene's.
pub fn motion(map: &Map, frame: &FrameFeatures, [before, after]: [&Se3; 2], reference: usize, config: &TrackingConfig) -> f64 {
    let after_from_before = after * before.inverse();
    let depth = frame.median_depth().or_else(|| map.median_depth(reference)).unwrap_or(1.0);
    let moved = after_from_before.translation.vector.norm() / (config.keyframe_translation * depth);
    moved.max(after_from_before.rotation.angle() / config.keyframe_rotation_rad)
}
