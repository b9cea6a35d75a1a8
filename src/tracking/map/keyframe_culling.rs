//! Culling of keyframes: those of which nearly all that they see is seen as well by others are given up, so that the map grows with what
//! is explored and not with time (the rule of Mur-Artal, Montiel & Tardós, *ORB-SLAM*, 2015, sec. VI-E).
//!
//! A culled keyframe keeps its id and its place in the list: its pose goes rigidly with the living keyframe that it shared most with.
//! But it sees nothing any more, and hence takes part in nothing.

use crate::tracking::TrackingConfig;
use crate::tracking::map::sparse_map::{Map, Observation};

/// Share of a keyframe's landmarks that must be seen elsewhere, and by how many other keyframes.
const REDUNDANT_SHARE: f64 = 0.9;
const OTHERS: usize = 3;
/// Pyramid levels by which they may see them coarser: as much as a corner is found on one level or the next by chance.
const COARSER: u8 = 1;
/// The newest keyframes stay: what they see is still growing.
const KEPT_NEWEST: usize = 5;
/// Keyframes among which one is given up when memory is short.
const EXAMINED: usize = 16;

/// Culls the redundant ones among the keyframes that share landmarks with `around`. `keep` names those that must stay; the first
/// keyframe of a submap and the newest ones stay as well. Returns the culled ones in the order in which they went.
pub fn cull_around(map: &mut Map, around: usize, keep: impl Fn(usize) -> bool, config: &TrackingConfig) -> Vec<usize> {
    let oldest_kept = map.keyframes.len().saturating_sub(KEPT_NEWEST);
    let mut culled = Vec::new();
    for (keyframe, _) in map.covisible(around) {
        if !map.is_root(keyframe)
            && keyframe < oldest_kept
            && !keep(keyframe)
            && is_redundant(map, keyframe)
            && cull(map, keyframe, &[], config)
        {
            culled.push(keyframe);
        }
    }
    culled
}

/// Whether others see nearly all of what a keyframe sees, about as finely as it does.
fn is_redundant(map: &Map, keyframe: usize) -> bool {
    let octave = |s: &Observation| map.keyframes[s.keyframe].features.features[s.feature].octave;
    let (mut seen, mut elsewhere) = (0, 0);
    for (feature, landmark) in map.keyframes[keyframe].landmarks.iter().enumerate() {
        let Some(landmark) = landmark else { continue };
        let own = octave(&Observation { keyframe, feature });
        let finer = |s: &&Observation| s.keyframe != keyframe && octave(s) <= own + COARSER;
        seen += 1;
        elsewhere += usize::from(map.landmarks[*landmark].observations.iter().filter(finer).nth(OTHERS - 1).is_some());
    }
    elsewhere as f64 >= REDUNDANT_SHARE * f64::from(seen) && seen > 0
}

/// Culls keyframes while the map is larger than `bytes`: one at a call, of the next few living ones after `from` the one of which others see most. So
/// keyframes become sparser where many see the same. Returns the keyframe after which the next call goes on.
pub fn thin(map: &mut Map, bytes: u64, from: usize, keep: impl Fn(usize) -> bool, config: &TrackingConfig) -> usize {
    let oldest_kept = map.keyframes.len().saturating_sub(KEPT_NEWEST);
    if map.bytes() <= bytes {
        return from;
    }
    let may_go = |k: &usize| !map.is_root(*k) && !keep(*k);
    let after = map.living.range(from + 1..oldest_kept.max(from + 1)).copied();
    let mut examined: Vec<usize> = after.filter(may_go).take(EXAMINED).collect();
    if examined.is_empty() {
        examined = map.living.range(..oldest_kept).copied().filter(may_go).take(EXAMINED).collect();
    }
    let seen_elsewhere = |k: &usize| {
        let seen = map.keyframes[*k].landmarks.iter().flatten();
        let (mut all, mut elsewhere) = (0, 0);
        for landmark in seen {
            all += 1;
            elsewhere += usize::from(map.landmarks[*landmark].observations.len() > 1);
        }
        // Without landmarks, nothing is lost with it.
        if all == 0 { 1.0 } else { f64::from(elsewhere as u32) / f64::from(all) }
    };
    let shares: Vec<(usize, f64)> = examined.iter().map(|k| (*k, seen_elsewhere(k))).collect();
    let most = shares.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
    if let Some((keyframe, _)) = most {
        // Where keyframes are sparse, the nearest may share nothing with it. The map's bytes bound their number.
        let living: Vec<usize> = map.living_in(map.keyframes[*keyframe].root).filter(|k| k != keyframe).collect();
        cull(map, *keyframe, &living, config);
    }
    examined.last().copied().unwrap_or(0)
}

/// Culls a keyframe; `false` if no other could be its parent. Pixels tie one that shares no landmarks to the one before it. `others` may be parents of
/// what it carries, too.
fn cull(map: &mut Map, keyframe: usize, others: &[usize], config: &TrackingConfig) -> bool {
    let mut parents: Vec<usize> = map.covisible(keyframe).into_iter().map(|(other, _)| other).collect();
    if parents.is_empty() {
        let root = map.keyframes[keyframe].root;
        parents.extend(map.living.range(..keyframe).next_back().filter(|other| map.keyframes[**other].root == root));
    }
    if parents.is_empty() {
        return false;
    }
    parents.extend_from_slice(others);
    for (feature, landmark) in map.keyframes[keyframe].landmarks.clone().into_iter().enumerate() {
        let Some(landmark) = landmark else { continue };
        map.remove_observation(landmark, Observation { keyframe, feature });
        map.refresh_geometry(landmark, config);
    }
    map.attach(keyframe, &parents);
    true
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::geometry::{Se3, se3};
    use crate::tracking::features::descriptor::Descriptor;
    use crate::tracking::features::frame_features::FrameFeatures;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::map::sparse_map::Keyframe;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::{Point3, Vector6};

    const LANDMARKS: usize = 40;

    /// Twelve keyframes in a row, all of which see the same landmarks, but for `own` that only keyframe 3 sees; its octave is its own.
    fn map(own: usize, octave: u8) -> Map {
        let mut map = Map::default();
        for id in 0..12 {
            let t = 0.1 * id as f64;
            let features: Vec<_> = (0..LANDMARKS + own)
                .map(|i| {
                    let mut feature = feature(10.0 * i as f64, 100.0, Descriptor([i as u64, id, 0, 0]));
                    feature.octave = if id == 3 { octave } else { 2 };
                    feature
                })
                .collect();
            let camera_from_world = se3::exp(&Vector6::new(t, 0.0, 0.0, 0.0, 0.1 * t, 0.0));
            let features = Arc::new(FrameFeatures::new(features, &PINHOLE));
            map.push(Keyframe::new(id as usize, t, camera_from_world, features));
            for feature in 0..LANDMARKS {
                let observation = Observation { keyframe: id as usize, feature };
                if id == 0 {
                    map.add_landmark(observation, Point3::new(0.1 * feature as f64, 0.0, 3.0), &TrackingConfig::default());
                } else {
                    map.add_observation(feature, observation);
                }
            }
        }
        for feature in LANDMARKS..LANDMARKS + own {
            map.add_landmark(Observation { keyframe: 3, feature }, Point3::new(0.0, 0.0, 2.0), &TrackingConfig::default());
        }
        map
    }

    fn cull_all(map: &mut Map, keep: usize) -> Vec<usize> {
        let mut culled = cull_around(map, 11, |k| k == keep, &TrackingConfig::default());
        culled.sort_unstable();
        culled
    }

    #[test]
    fn what_others_see_is_given_up_and_what_only_one_sees_stays() {
        assert_eq!(cull_all(&mut map(4, 2), 2), [1, 3, 4, 5, 6]);
        assert_eq!(cull_all(&mut map(5, 2), 2), [1, 4, 5, 6], "5 of 45 landmarks are its own");
        assert_eq!(cull_all(&mut map(0, 1), 2), [1, 3, 4, 5, 6]);
        assert_eq!(cull_all(&mut map(0, 0), 2), [1, 4, 5, 6], "it sees them finer than the others");
    }

    #[test]
    fn a_culled_keyframe_sees_nothing_and_goes_with_its_holder() {
        let mut map = map(0, 2);
        let places = map.database.query(&map.keyframes[5].features.features.clone());
        assert!(places.iter().any(|p| p.keyframe == 5));
        let poses: Vec<Se3> = map.keyframes.iter().map(|k| k.camera_from_world).collect();
        let gone = map.keyframes[5].features.features.clone();
        assert_eq!(cull_all(&mut map, 2), [1, 3, 4, 5, 6]);
        assert!(map.database.query(&gone).iter().all(|p| p.keyframe != 5));
        assert!(map.covisible(11).iter().all(|(k, _)| !map.is_culled(*k)));
        assert!(map.landmarks.iter().all(|l| l.observations.iter().all(|s| !map.is_culled(s.keyframe))));
        assert!(map.keyframes.iter().filter_map(|k| k.parent).all(|p| !map.is_culled(p)), "nobody is held by one that is held");
        let push = se3::exp(&Vector6::new(0.3, -0.1, 0.2, 0.2, 0.1, 0.4));
        for k in (0..12).filter(|k| !map.is_culled(*k)).collect::<Vec<_>>() {
            map.set_pose(k, map.keyframes[k].camera_from_world * push);
        }
        for (k, pose) in poses.iter().enumerate() {
            assert!(se3::log(&(map.keyframes[k].camera_from_world * (pose * push).inverse())).norm() < 1e-9, "{k}");
        }
    }

    #[test]
    fn a_map_beyond_its_memory_becomes_sparser_and_one_within_stays() {
        let config = TrackingConfig::default();
        let mut map = map(4, 2);
        let bytes = map.bytes();
        assert_eq!(thin(&mut map, bytes, 0, |_| false, &config), 0);
        assert!(map.living.len() == 12);
        let mut from = 0;
        (0..20).for_each(|_| from = thin(&mut map, bytes / 4 * 3, from, |k| k == 2, &config));
        assert!(map.bytes() <= bytes / 4 * 3, "{} of {bytes} bytes", map.bytes());
        assert!(map.living.contains(&0) && map.living.contains(&2) && map.living.contains(&11));
        assert!(map.living.contains(&3), "what it sees nobody else sees");
        let least = map.living.len();
        (0..20).for_each(|_| from = thin(&mut map, 0, from, |k| k == 2, &config));
        assert!(map.living.len() < least && [0, 2, 7, 8, 9, 10, 11].iter().all(|k| map.living.contains(k)));
    }
}
