//! Local bundle adjustment: makes a [`BundleProblem`] of a keyframe's surroundings and takes the result into the map
//! (the windowed scheme of Mur-Artal & Tardós, *ORB-SLAM2*, 2017).
//!
//! The keyframe and those that share most landmarks with it may move, with all their landmarks; other keyframes that see these
//! landmarks hold them in place. The first keyframe is the world and never moves.

use super::TrackingConfig;
use super::bundle::{BundleObservation, BundleProblem};
use super::map::{Map, Sighting};
use super::measurement::Trust;
use crate::geometry::{Pinhole, Se3};

/// Keyframes that share fewer landmarks than this are not moved together.
const MIN_SHARED: usize = 15;
/// Keyframes that hold the window in place, at most; bounds the time.
const MAX_FIXED: usize = 40;

/// Adjusts the window around `keyframe`; returns the keyframes that may have moved, in ascending order.
pub fn adjust_window(map: &mut Map, keyframe: usize, pinhole: &Pinhole, config: &TrackingConfig) -> Vec<usize> {
    let (free, fixed) = choose_window(map, keyframe, config);
    adjust(map, &free, &fixed, pinhole, config)
}

/// Adjusts the keyframes `free` and all their landmarks, held in place by `fixed`; returns `free` in ascending order, or nothing if
/// nothing was done.
pub fn adjust(map: &mut Map, free: &[usize], fixed: &[usize], pinhole: &Pinhole, config: &TrackingConfig) -> Vec<usize> {
    if free.is_empty() || config.bundle_iterations == 0 {
        return Vec::new();
    }
    let all_landmarks = map.landmarks_of(free);
    let (landmarks, single): (Vec<usize>, Vec<usize>) =
        all_landmarks.into_iter().partition(|l| map.landmarks[*l].sightings.len() > 1);
    let keyframes: Vec<usize> = free.iter().chain(fixed).copied().collect();
    let (mut problem, sightings) = make_problem(map, &keyframes, free.len(), &landmarks, config);
    problem.solve(pinhole, config.bundle_iterations);
    problem.judge(pinhole);
    problem.solve(pinhole, config.bundle_iterations);
    problem.judge(pinhole);

    let before: Vec<Se3> = free.iter().map(|k| map.keyframes[*k].camera_from_world).collect();
    for (k, pose) in free.iter().zip(&problem.poses) {
        map.keyframes[*k].camera_from_world = *pose;
    }
    for (l, point) in landmarks.iter().zip(&problem.points) {
        map.landmarks[*l].position = *point;
    }
    // What only one keyframe sees goes with it.
    for l in single {
        let owner = map.landmarks[l].sightings[0].keyframe;
        if let Some(k) = free.iter().position(|f| *f == owner) {
            let p_in_camera = before[k] * map.landmarks[l].position;
            map.landmarks[l].position = problem.poses[k].inverse_transform_point(&p_in_camera);
        }
    }
    for (o, sighting) in problem.observations.iter().zip(&sightings) {
        if o.trust == Trust::Outlier {
            map.remove_sighting(landmarks[o.point], *sighting);
        }
    }
    for l in &landmarks {
        map.refresh_geometry(*l, config);
    }
    let mut moved = free.to_vec();
    moved.sort_unstable();
    moved
}

/// Keyframes that move (`keyframe` among them) and keyframes that hold them.
fn choose_window(map: &Map, keyframe: usize, config: &TrackingConfig) -> (Vec<usize>, Vec<usize>) {
    let neighbours = map.covisible(keyframe).into_iter().filter(|(_, shared)| *shared >= MIN_SHARED).map(|(k, _)| k);
    let mut free: Vec<usize> = std::iter::once(keyframe).chain(neighbours).take(config.window_keyframes).collect();
    free.retain(|k| *k != 0);
    let landmarks = map.landmarks_of(&free);
    let votes = map.votes(landmarks.into_iter());
    let mut fixed: Vec<usize> = votes.into_iter().map(|(k, _)| k).filter(|k| !free.contains(k)).take(MAX_FIXED).collect();
    if fixed.is_empty()
        && let Some(oldest) = free.iter().copied().min()
    {
        free.retain(|k| *k != oldest);
        fixed.push(oldest);
    }
    (free, fixed)
}

fn make_problem(
    map: &Map,
    keyframes: &[usize],
    free_poses: usize,
    landmarks: &[usize],
    config: &TrackingConfig,
) -> (BundleProblem, Vec<Sighting>) {
    let mut place = vec![None; map.keyframes.len()];
    keyframes.iter().enumerate().for_each(|(i, k)| place[*k] = Some(i));
    let mut problem = BundleProblem {
        poses: keyframes.iter().map(|k| map.keyframes[*k].camera_from_world).collect(),
        free_poses,
        points: landmarks.iter().map(|l| map.landmarks[*l].position).collect(),
        observations: Vec::new(),
    };
    let mut sightings = Vec::new();
    for (point, l) in landmarks.iter().enumerate() {
        for sighting in &map.landmarks[*l].sightings {
            let Some(pose) = place[sighting.keyframe] else { continue };
            let measurement = map.keyframes[sighting.keyframe].features.features[sighting.feature].measurement(config);
            let trust = if measurement.inverse_depth.is_some() { Trust::Full } else { Trust::PixelOnly };
            problem.observations.push(BundleObservation { pose, point, measurement, trust });
            sightings.push(*sighting);
        }
    }
    (problem, sightings)
}
