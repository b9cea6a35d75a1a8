//! What a new keyframe does to the sparse map: new landmarks from depth, joining with what its neighbours see, removal of landmarks
//! that did not prove themselves (local mapping of Mur-Artal & Tardós, *ORB-SLAM2*, 2017, without its threads).

use std::collections::BTreeSet;

use crate::tracking::features::matching::Rules;
use crate::tracking::features::projection::{PointMatch, ProjectionSearch};
use crate::tracking::map::sparse_map::{Keyframe, LandmarkState, Map, Observation};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::residual::InlierClass;

/// Keyframes with which landmarks are joined: those sharing most landmarks. What lies near but shares none is a matter for
/// `loop_closing`, which spreads the drift between the two instead of bending one over to the other.
const FUSED_COVISIBLE: usize = 10;
/// Search radius when joining, pixels at the finest level.
const FUSE_RADIUS: f64 = 3.0;
const FUSE_SEARCH: ProjectionSearch =
    ProjectionSearch { taken: &[], coarser_octaves: 0, rules: Rules { max_distance: 50, ratio: 1.0, check_rotation: false } };
/// A landmark is on probation for this many keyframes, and must then be seen by two; by three if it was triangulated from two.
const RECENT_KEYFRAMES: usize = 3;
/// Share of the frames that should see a landmark which must do so.
const MIN_OBSERVED_SHARE: f64 = 0.25;

/// Puts a keyframe in the map with the landmarks that its frame was tracked by; makes new ones from depth. Returns its id.
pub fn insert_keyframe(map: &mut Map, mut keyframe: Keyframe, rig: &Rig) -> usize {
    let config = &rig.config;
    let features = keyframe.features.clone();
    let tracked = std::mem::replace(&mut keyframe.landmarks, vec![None; features.len()]);
    let world_from_camera = keyframe.camera_from_world.inverse();
    let id = map.push(keyframe);
    for (feature, landmark) in tracked.into_iter().enumerate() {
        if let Some(landmark) = landmark.and_then(|l| map.resolve(l)) {
            map.add_observation(landmark, Observation { keyframe: id, feature });
            map.refresh_descriptor(landmark);
            map.refresh_geometry(landmark, config);
        }
    }
    for feature in 0..features.len() {
        let free = map.keyframes[id].landmarks[feature].is_none();
        if let Some(p_in_camera) = features.point_in_camera(feature, rig).filter(|_| free) {
            map.add_landmark(Observation { keyframe: id, feature }, world_from_camera * p_in_camera, config);
        }
    }
    id
}

/// Joins the landmarks of a keyframe with those of its neighbours, both ways.
pub fn fuse_with_neighbours(map: &mut Map, keyframe: usize, rig: &Rig) {
    let neighbours: Vec<usize> = map.covisible(keyframe).into_iter().take(FUSED_COVISIBLE).map(|(k, _)| k).collect();
    for other in &neighbours {
        let own: Vec<usize> = map.keyframes[keyframe].landmarks.iter().flatten().copied().collect();
        fuse(map, *other, &own, rig);
    }
    let theirs = map.landmarks_of(&neighbours);
    fuse(map, keyframe, &theirs, rig);
}

/// Looks for `landmarks` in a keyframe: adds observations, and merges where the feature found shows another landmark.
pub fn fuse(map: &mut Map, keyframe: usize, landmarks: &[usize], rig: &Rig) {
    let Rig { pinhole, config, .. } = rig;
    let target = &map.keyframes[keyframe];
    let unseen = |l: &usize| map.landmarks[*l].state == LandmarkState::Alive && !map.landmarks[*l].seen_by(keyframe);
    let visible = map.visible(landmarks.iter().copied().filter(unseen), &target.camera_from_world, rig);
    let features = target.features.clone();
    let mut changed = BTreeSet::new();
    for PointMatch { point: landmark, feature } in FUSE_SEARCH.run(&features, &visible, |_| FUSE_RADIUS, rig) {
        let p_in_camera = (map.keyframes[keyframe].camera_from_world * map.position(landmark)).coords;
        if rig.measurement(&features.features[feature]).classify(pinhole, &p_in_camera) == InlierClass::Outlier {
            continue;
        }
        match map.keyframes[keyframe].landmarks[feature] {
            None => {
                map.add_observation(landmark, Observation { keyframe, feature });
                changed.insert(landmark);
            }
            Some(other) => {
                let more = |l: usize| map.landmarks[l].observations.len();
                let (from, into) = if more(other) >= more(landmark) { (landmark, other) } else { (other, landmark) };
                map.merge(from, into);
                changed.insert(into);
            }
        }
    }
    for landmark in changed {
        map.refresh_descriptor(landmark);
        map.refresh_geometry(landmark, config);
    }
}

/// Removes landmarks that ended their probation badly, and those rarely found where they should be.
pub fn cull_recent_landmarks(map: &mut Map, newest_keyframe: usize) {
    while map.probation.front().is_some_and(|(_, made_by)| made_by + RECENT_KEYFRAMES < newest_keyframe) {
        map.probation.pop_front();
    }
    for i in 0..map.probation.len() {
        let (l, made_by) = map.probation[i];
        let landmark = &map.landmarks[l];
        if landmark.state != LandmarkState::Alive || landmark.first_keyframe != made_by {
            continue;
        }
        let age = newest_keyframe - landmark.first_keyframe;
        let rarely_found = f64::from(landmark.observed) < MIN_OBSERVED_SHARE * f64::from(landmark.observable);
        let measured =
            landmark.observations.iter().any(|s| map.keyframes[s.keyframe].features.features[s.feature].depth_metres.is_some());
        let alone = age == RECENT_KEYFRAMES && landmark.observations.len() < if measured { 2 } else { 3 };
        if alone || rarely_found {
            map.remove_landmark(l);
        }
    }
}
