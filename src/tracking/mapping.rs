//! What a new keyframe does to the sparse map: new landmarks from depth, joining with what its neighbours see, removal of landmarks
//! that did not prove themselves (local mapping of Mur-Artal & Tardós, *ORB-SLAM2*, 2017, without its threads).

use std::collections::BTreeSet;

use super::TrackingConfig;
use super::map::{Fate, Keyframe, Map, Sighting};
use super::matching::{Query, Rules, match_by_projection};
use super::measurement::Trust;
use crate::geometry::Pinhole;

/// Keyframes with which landmarks are joined: those sharing most landmarks, and those nearby that share few or none (this closes
/// small loops while the drift is still within the search radius).
const JOINED_COVISIBLE: usize = 10;
const JOINED_NEARBY: usize = 4;
/// Nearby: within this share of the median depth, and looking within about 40° of the same direction.
const NEARBY_SHARE: f64 = 0.5;
const NEARBY_COSINE: f64 = 0.77;
/// Search radius when joining, pixels at the finest level.
const JOIN_RADIUS: f64 = 3.0;
const JOIN_RULES: Rules = Rules { max_distance: 50, ratio: 1.0, check_rotation: false };
/// A landmark is on probation for this many keyframes, and must then be seen by two.
const PROBATION: usize = 3;
/// Share of the frames that should see a landmark which must do so.
const MIN_FOUND_SHARE: f64 = 0.25;

/// Puts a keyframe in the map with the landmarks that its frame was tracked by; makes new ones from depth. Returns its id.
pub fn insert_keyframe(map: &mut Map, mut keyframe: Keyframe, pinhole: &Pinhole, config: &TrackingConfig) -> usize {
    let id = map.keyframes.len();
    let tracked = std::mem::take(&mut keyframe.landmarks);
    let features = keyframe.features.clone();
    let world_from_camera = keyframe.camera_from_world.inverse();
    keyframe.landmarks = vec![None; features.len()];
    map.keyframes.push(keyframe);
    map.places.insert(id, &features.features);
    for (feature, landmark) in tracked.into_iter().enumerate() {
        if let Some(landmark) = landmark.and_then(|l| map.resolve(l)) {
            map.add_sighting(landmark, Sighting { keyframe: id, feature });
            map.refresh_descriptor(landmark);
            map.refresh_geometry(landmark, config);
        }
    }
    for feature in 0..features.len() {
        let free = map.keyframes[id].landmarks[feature].is_none();
        if let Some(p_in_camera) = features.point_in_camera(feature, pinhole).filter(|_| free) {
            map.add_landmark(Sighting { keyframe: id, feature }, world_from_camera * p_in_camera, config);
        }
    }
    id
}

/// Joins the landmarks of a keyframe with those of its neighbours, both ways.
pub fn join_neighbours(map: &mut Map, keyframe: usize, pinhole: &Pinhole, config: &TrackingConfig) {
    let neighbours = neighbours(map, keyframe);
    for other in &neighbours {
        let own: Vec<usize> = map.keyframes[keyframe].landmarks.iter().flatten().copied().collect();
        join(map, *other, &own, pinhole, config);
    }
    let theirs = map.landmarks_of(&neighbours);
    join(map, keyframe, &theirs, pinhole, config);
}

fn neighbours(map: &Map, keyframe: usize) -> Vec<usize> {
    let covisible = map.covisible(keyframe);
    let mut chosen: Vec<usize> = covisible.iter().take(JOINED_COVISIBLE).map(|(k, _)| *k).collect();
    let this = &map.keyframes[keyframe];
    let reach = NEARBY_SHARE * this.features.median_depth().unwrap_or(1.0);
    let mut nearby: Vec<(f64, usize)> = Vec::new();
    for (k, other) in map.keyframes.iter().enumerate() {
        let distance = (other.centre() - this.centre()).norm() / reach;
        let cosine = other.forward().dot(&this.forward());
        if k != keyframe && !chosen.contains(&k) && distance < 1.0 && cosine > NEARBY_COSINE {
            nearby.push((distance + (1.0 - cosine), k));
        }
    }
    nearby.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    chosen.extend(nearby.into_iter().take(JOINED_NEARBY).map(|(_, k)| k));
    chosen
}

/// Looks for `landmarks` in a keyframe: adds sightings, and merges where the feature found shows another landmark.
pub fn join(map: &mut Map, keyframe: usize, landmarks: &[usize], pinhole: &Pinhole, config: &TrackingConfig) {
    let target = &map.keyframes[keyframe];
    let (mut asked, mut queries) = (Vec::new(), Vec::new());
    for l in landmarks {
        let landmark = &map.landmarks[*l];
        if landmark.fate != Fate::Alive || landmark.seen_by(keyframe) {
            continue;
        }
        let Some(seen) = map.predict(*l, &target.camera_from_world, pinhole, config) else { continue };
        asked.push(*l);
        queries.push(Query {
            pixel: seen.pixel,
            radius: JOIN_RADIUS * config.pyramid_scale.powi(seen.octave.into()),
            octaves: seen.octave.saturating_sub(1)..=seen.octave,
            descriptor: landmark.descriptor,
            angle_rad: 0.0,
            inverse_depth: seen.inverse_depth,
        });
    }
    let features = target.features.clone();
    let mut changed = BTreeSet::new();
    for m in match_by_projection(&features, &[], &queries, &JOIN_RULES) {
        let landmark = asked[m.query];
        let p_in_camera = (map.keyframes[keyframe].camera_from_world * map.landmarks[landmark].position).coords;
        if features.features[m.feature].measurement(config).judge(pinhole, &p_in_camera) == Trust::Outlier {
            continue;
        }
        match map.keyframes[keyframe].landmarks[m.feature] {
            None => {
                map.add_sighting(landmark, Sighting { keyframe, feature: m.feature });
                changed.insert(landmark);
            }
            Some(other) => {
                let more = |l: usize| map.landmarks[l].sightings.len();
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
pub fn remove_unproven(map: &mut Map, newest_keyframe: usize) {
    for l in 0..map.landmarks.len() {
        let landmark = &map.landmarks[l];
        let age = newest_keyframe - landmark.born;
        let rarely_found = f64::from(landmark.found) < MIN_FOUND_SHARE * f64::from(landmark.visible);
        let alone = age == PROBATION && landmark.sightings.len() < 2;
        if landmark.fate == Fate::Alive && (alone || (age <= PROBATION && rarely_found)) {
            map.remove_landmark(l);
        }
    }
}
