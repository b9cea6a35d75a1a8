//! What a closed loop does to the map: the drift is spread over the keyframes by a pose graph, landmarks follow the keyframe that saw
//! them first, and what turned out to be the same is joined (Mur-Artal, Montiel & Tardós, *ORB-SLAM*, 2015: the *essential graph*). The
//! bundle adjustment of all keyframes that settles the rest is up to the caller.

use crate::geometry::sim3::Vector7;
use crate::geometry::{Se3, Sim3};
use crate::tracking::TrackingConfig;
use crate::tracking::loop_closing::detection::{CONNECTED_SHARED, Recognised};
use crate::tracking::map::insertion::fuse;
use crate::tracking::map::sparse_map::{LandmarkState, Map, Observation};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose_graph::{Edge, PoseGraph};

/// Keyframes that share this many landmarks are held to their relative pose, besides each one and the one it shares most with.
const STRONG_SHARED: usize = 100;
const STRONG_NEIGHBOURS: usize = 5;
/// Standard deviation of the relative pose of two keyframes that share [`STRONG_SHARED`] landmarks, metres at a metre's distance and
/// radians, and of the logarithm of their scales. Only their ratios matter, and how they compare with [`HUBER_SIGMAS`].
const SIGMA_TRANSLATION: f64 = 0.003;
const SIGMA_ROTATION_RAD: f64 = 0.002;
const SIGMA_SCALE: f64 = 0.005;
/// Loops that disagree by more than this many standard deviations pull less and less.
const HUBER_SIGMAS: f64 = 10.0;
const GRAPH_STEPS: usize = 30;
/// Neighbours of the keyframe in which the place's landmarks are joined with theirs.
const FUSED_NEIGHBOURS: usize = 10;

/// A keyframe after a correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovedKeyframe {
    /// Its id.
    pub keyframe: usize,
    /// Factor by which lengths around it have grown.
    pub growth: f64,
}

/// Closes a recognised loop; `edges` are those of earlier loops and get this one's. Returns the keyframes that may have moved.
pub fn correct(map: &mut Map, found: &Recognised, edges: &mut Vec<Edge>, scale_is_free: bool, rig: &Rig) -> Vec<MovedKeyframe> {
    let config = &rig.config;
    let before: Vec<Se3> = map.keyframes.iter().map(|k| k.camera_from_world).collect();
    let keyframe_from_place = found.corrected * Sim3::from(before[found.place]).inverse();
    let depth = map.keyframes[found.keyframe].features.median_depth().or_else(|| map.median_depth(found.keyframe)).unwrap_or(1.0);
    edges.push(Edge {
        huber: Some(HUBER_SIGMAS),
        ..edge(found.keyframe, found.place, keyframe_from_place, found.matches.len(), depth)
    });
    let poses: Vec<Sim3> = before.iter().map(|p| Sim3::from(*p)).collect();
    let after = if map.connects(found.keyframe, found.place) {
        let mut graph = PoseGraph { poses, edges: skeleton(map, depth), scale_is_free };
        graph.edges.extend(edges.iter());
        graph.optimise(GRAPH_STEPS);
        graph.poses
    } else {
        join(map, found, poses)
    };
    move_map(map, &before, &after, config);
    let living: Vec<usize> = (0..before.len()).map(|k| map.living(k)).collect();
    let growth = |k: usize| 1.0 / after[living[k]].scale;
    map.culled.iter_mut().for_each(|(k, held)| held.camera_from_parent.translation.vector *= growth(*k));
    map.carry_culled();
    let neighbours: Vec<usize> =
        map.covisible(found.keyframe).into_iter().filter(|(_, n)| *n >= CONNECTED_SHARED).map(|(k, _)| k).collect();
    take_over(map, found, config);
    fuse(map, found.keyframe, &found.landmarks, rig);
    for neighbour in neighbours.into_iter().take(FUSED_NEIGHBOURS) {
        fuse(map, neighbour, &found.landmarks, rig);
    }
    let moved = (1..after.len()).filter(|k| after[living[*k]] != Sim3::from(before[living[*k]]));
    moved.map(|k| MovedKeyframe { keyframe: k, growth: growth(k) }).collect()
}

/// Makes one submap of two that show the same place: the younger moves as a whole to where the older shows it. Returns all poses after it.
fn join(map: &mut Map, found: &Recognised, mut poses: Vec<Sim3>) -> Vec<Sim3> {
    let (current, place) = (map.keyframes[found.keyframe].root, map.keyframes[found.place].root);
    // Where the place's submap lies in that of the keyframe.
    let current_from_place = poses[found.keyframe].inverse() * found.corrected;
    let (older, younger) = (current.min(place), current.max(place));
    let younger_from_older = if younger == current { current_from_place } else { current_from_place.inverse() };
    for (keyframe, pose) in map.keyframes.iter_mut().zip(&mut poses).filter(|(k, _)| k.root == younger) {
        keyframe.root = older;
        *pose = *pose * younger_from_older;
    }
    poses
}

/// The edges that hold the map together: each keyframe with the older one that it shares most with, and with others if that is much.
fn skeleton(map: &Map, depth: f64) -> Vec<Edge> {
    let mut edges = Vec::new();
    let mut last = 0;
    for a in (1..map.keyframes.len()).filter(|k| !map.culled.contains_key(k)) {
        let older: Vec<(usize, usize)> = map.covisible(a).into_iter().filter(|(b, _)| *b < a).take(STRONG_NEIGHBOURS).collect();
        let (parent, shared) = older.first().copied().unwrap_or((last, 1));
        last = a;
        let strong = older.into_iter().skip(1).filter(|(_, shared)| *shared >= STRONG_SHARED);
        for (b, shared) in std::iter::once((parent, shared)).chain(strong) {
            let a_from_b = map.keyframes[a].camera_from_world * map.keyframes[b].camera_from_world.inverse();
            edges.push(edge(a, b, Sim3::from(a_from_b), shared, depth));
        }
    }
    edges
}

fn edge(a: usize, b: usize, a_from_b: Sim3, shared: usize, depth: f64) -> Edge {
    let certainty = (shared as f64 / STRONG_SHARED as f64).sqrt();
    let (t, r) = (certainty / (SIGMA_TRANSLATION * depth), certainty / SIGMA_ROTATION_RAD);
    let weights = Vector7::from_column_slice(&[t, t, t, r, r, r, certainty / SIGMA_SCALE]);
    Edge { a, b, a_from_b, weights, huber: None }
}

/// Keyframes to their new poses; each landmark goes with the keyframe that saw it first.
fn move_map(map: &mut Map, before: &[Se3], after: &[Sim3], config: &TrackingConfig) {
    for landmark in map.landmarks.iter_mut().filter(|l| l.state == LandmarkState::Alive) {
        let Some(anchor) = landmark.observations.first().map(|s| s.keyframe) else { continue };
        landmark.position = after[anchor].inverse().act(&(before[anchor] * landmark.position));
    }
    for (keyframe, pose) in map.keyframes.iter_mut().zip(after) {
        keyframe.camera_from_world = pose.to_rigid();
    }
    for l in 0..map.landmarks.len() {
        map.refresh_geometry(l, config);
    }
}

/// The place's landmarks take over what the keyframe's features showed.
fn take_over(map: &mut Map, found: &Recognised, config: &TrackingConfig) {
    for (landmark, feature) in &found.matches {
        let Some(landmark) = map.resolve(*landmark) else { continue };
        match map.keyframes[found.keyframe].landmarks[*feature] {
            Some(own) => map.merge(own, landmark),
            None => map.add_observation(landmark, Observation { keyframe: found.keyframe, feature: *feature }),
        }
        map.refresh_descriptor(landmark);
        map.refresh_geometry(landmark, config);
    }
}
