//! Bundle adjustment of a part of the map: makes a [`BundleProblem`] of keyframes and their landmarks and takes the result into the map
//! (the windowed scheme of Mur-Artal & Tardós, *ORB-SLAM2*, 2017).
//!
//! A keyframe and those that share most landmarks with it may move, with all their landmarks; other keyframes that see these
//! landmarks hold them in place. The first keyframe of a submap is its world and never moves. An [`Adjustment`] is a plain value that can be solved
//! elsewhere while the map goes on: taking it in touches only what is still there.

use std::collections::BTreeMap;

use crate::geometry::{Pinhole, Se3};
use crate::tracking::TrackingConfig;
use crate::tracking::map::sparse_map::{Map, Observation};
use crate::tracking::map::tally::distinct;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::bundle::{BundleObservation, BundleProblem, CONVERGED};
use crate::tracking::solvers::depth_bias::{BiasPrior, DepthBias};
use crate::tracking::solvers::relative_pose::RelativePose;
use crate::tracking::solvers::residual::{InlierClass, Measurement};

/// Keyframes that share fewer landmarks than this are not moved together.
const MIN_SHARED: usize = 15;
/// Keyframes that hold the window in place, at most; bounds the time.
const MAX_FIXED: usize = 40;
/// As [`CONVERGED`], for a window without relative poses. More steps gain little there, and the next window goes on from the result.
const CONVERGED_HELD: f64 = 3e-3;

/// A frame between keyframes that holds landmarks as well.
#[derive(Clone, Debug)]
pub struct FrameView {
    pub camera_from_world: Se3,
    /// Landmarks and where they were measured.
    pub seen: Vec<(usize, Measurement)>,
    /// Its pose relative to a keyframe, which `reference` names.
    pub relative_pose: Option<RelativePose>,
}

/// A part of the map to be adjusted: the problem, and what its numbers mean.
#[derive(Clone, Debug, Default)]
pub struct Adjustment {
    pub problem: BundleProblem,
    /// The keyframe of each pose, but for frames, whose poses follow the free keyframes'.
    keyframes: Vec<usize>,
    free_keyframes: usize,
    /// Keyframes beside these that go rigidly with the one that they share most landmarks with.
    carried: Vec<usize>,
    /// The landmark of each point.
    landmarks: Vec<usize>,
    /// The keyframe's observation of each observation; `None` for those of frames.
    observations: Vec<Option<Observation>>,
    /// Keyframes in the map when it was made, and corrections of the whole until then.
    known: usize,
    corrections: usize,
    /// Share of the cost by which a step must lower it to be followed by another.
    converged_share: f64,
}

impl Adjustment {
    /// Local bundle adjustment around `keyframe`; `None` if nothing in its window may move.
    pub fn of_window(map: &Map, keyframe: usize, rig: &Rig) -> Option<Self> {
        let (free, fixed) = choose_window(map, keyframe, &rig.config);
        let window = Self::new(map, &free, &fixed, rig)?;
        let is_held = window.problem.relative_poses.is_empty();
        Some(Self { converged_share: if is_held { CONVERGED_HELD } else { CONVERGED }, ..window })
    }

    /// Global bundle adjustment of the submap that begins with `root`; `None` if it has more observations than that. Few landmarks would tear a
    /// keyframe from where all pixels put it: such a keyframe is carried, unless relative poses hold it.
    pub fn of_all(map: &Map, root: usize, most_observations: usize, rig: &Rig) -> Option<Self> {
        let mut observations = 0;
        for keyframe in map.living_in(root) {
            let landmarks = map.keyframes[keyframe].landmarks.iter().flatten();
            observations += landmarks.filter(|l| map.landmarks[**l].observations.len() > 1).count();
            if observations > most_observations {
                return None;
            }
        }
        let is_held = |k: &usize| {
            map.relative_poses(*k).next().is_some() || map.covisible(*k).first().is_some_and(|(_, shared)| *shared >= MIN_SHARED)
        };
        let (free, carried): (Vec<usize>, Vec<usize>) = map.living_in(root).filter(|k| *k != root).partition(is_held);
        Some(Self { carried, ..Self::new(map, &free, &[root], rig)? })
    }

    /// Bundle adjustment of the keyframes `free` and all their landmarks, with `fixed` held constant.
    fn new(map: &Map, free: &[usize], fixed: &[usize], rig: &Rig) -> Option<Self> {
        if free.is_empty() || rig.config.bundle_iterations == 0 {
            return None;
        }
        let mut landmarks = map.landmarks_of(free);
        landmarks.retain(|l| map.landmarks[*l].observations.len() > 1);
        let keyframes: Vec<usize> = free.iter().chain(fixed).copied().collect();
        let (problem, observations) = make_problem(map, &keyframes, free.len(), &landmarks, rig);
        let (known, corrections) = (map.keyframes.len(), map.corrections);
        Some(Self {
            problem,
            keyframes,
            free_keyframes: free.len(),
            carried: Vec::new(),
            landmarks,
            observations,
            known,
            corrections,
            converged_share: CONVERGED,
        })
    }

    /// With frames beside the keyframes. Their poses are unknowns too, which the map does not take in.
    #[must_use]
    pub fn with_frames(mut self, frames: &[FrameView]) -> Self {
        let problem = &mut self.problem;
        let (first, count) = (problem.free_poses, frames.len());
        let shift = |pose: &mut usize| *pose += if *pose >= first { count } else { 0 };
        problem.observations.iter_mut().for_each(|o| shift(&mut o.pose));
        problem.relative_poses.iter_mut().for_each(|r| [&mut r.current, &mut r.reference].into_iter().for_each(shift));
        problem.poses.splice(first..first, frames.iter().map(|frame| frame.camera_from_world));
        problem.free_poses += count;
        let pose_of: BTreeMap<usize, usize> = self.keyframes.iter().enumerate().map(|(pose, k)| (*k, pose)).collect();
        let relative_pose = |(k, frame): (usize, &FrameView)| {
            let relative = frame.relative_pose?;
            let mut reference = *pose_of.get(&relative.reference)?;
            shift(&mut reference);
            Some(RelativePose { current: first + k, reference, ..relative })
        };
        problem.relative_poses.extend(frames.iter().enumerate().filter_map(relative_pose));
        let place: BTreeMap<usize, usize> = self.landmarks.iter().enumerate().map(|(point, l)| (*l, point)).collect();
        let by_keyframes = problem.observations.len();
        let of_keyframes = problem.observations.drain(..).zip(self.observations.drain(..));
        let of_frames = frames.iter().enumerate().flat_map(|(k, frame)| {
            let seen = frame.seen.iter().filter_map(|(l, measurement)| Some((*place.get(l)?, *measurement)));
            seen.map(move |(point, measurement)| (BundleObservation::new(first + k, point, measurement), None))
        });
        let mut all: Vec<(BundleObservation, Option<Observation>)> = of_keyframes.chain(of_frames).collect();
        all.sort_by_key(|(o, _)| o.point);
        // They err as the keyframes beside them do: the prior counts as much as without them.
        if let Some(prior) = &mut self.problem.bias_prior {
            prior.information *= all.len() as f64 / by_keyframes.max(1) as f64;
        }
        (self.problem.observations, self.observations) = all.into_iter().unzip();
        self
    }

    /// With the bias of measured depth among the unknowns.
    #[must_use]
    pub fn with_bias(mut self, prior: BiasPrior) -> Self {
        self.problem.bias_prior = Some(prior);
        self
    }

    /// The bias that it found, if that was sought.
    pub fn bias(&self) -> Option<DepthBias> {
        self.problem.bias_prior.map(|_| self.problem.depth_bias)
    }

    /// Moves poses and points to where they agree best, twice: outliers are found by the first round and left out of the second.
    pub fn solve(&mut self, pinhole: &Pinhole, steps: usize) {
        for _ in 0..2 {
            self.problem.solve(pinhole, steps, self.converged_share);
            self.problem.classify(pinhole);
        }
    }

    /// Whether the map is still the one that this was made of: no correction of the whole came between.
    pub fn fits(&self, map: &Map) -> bool {
        self.corrections == map.corrections
    }

    /// Takes the result into the map; returns the keyframes that may have moved, in ascending order. Those that came since go
    /// rigidly with the older one that they share most with, as do those that were left out. What hangs on a keyframe goes with it.
    pub fn apply(&self, map: &mut Map, config: &TrackingConfig) -> Vec<usize> {
        let free = &self.keyframes[..self.free_keyframes];
        let mut before: BTreeMap<usize, Se3> = BTreeMap::new();
        for (k, pose) in free.iter().zip(&self.problem.poses) {
            if map.is_culled(*k) {
                continue;
            }
            before.insert(*k, map.keyframes[*k].camera_from_world);
            map.set_pose(*k, *pose);
        }
        for other in self.carried.iter().copied().chain(self.known..map.keyframes.len()) {
            let covisible = map.covisible(other).into_iter().map(|(k, _)| k).find(|k| *k < other || before.contains_key(k));
            // Pixels tie a keyframe that shares no landmarks to the one before it.
            let preceding = || map.living.range(..other).next_back().copied();
            // With one that stays, it stays: what the window has moved may be far away.
            let has_moved = |k: &usize| before.contains_key(k) && map.keyframes[*k].root == map.keyframes[other].root;
            let Some(neighbour) = covisible.or_else(preceding).filter(has_moved) else { continue };
            let pose = map.keyframes[other].camera_from_world;
            let other_from_neighbour = pose * before[&neighbour].inverse();
            before.insert(other, pose);
            map.set_pose(other, other_from_neighbour * map.keyframes[neighbour].camera_from_world);
        }
        for (l, point) in self.landmarks.iter().zip(&self.problem.points) {
            if map.is_alive_since(*l, self.known) {
                map.set_position(*l, point);
            }
        }
        for (o, observation) in self.problem.observations.iter().zip(&self.observations) {
            let Some(observation) = observation else { continue };
            let landmark = self.landmarks[o.point];
            let seen = map.keyframes[observation.keyframe].landmarks.get(observation.feature);
            let is_seen = seen == Some(&Some(landmark)) && map.is_alive_since(landmark, self.known);
            if o.class == InlierClass::Outlier && is_seen {
                map.remove_observation(landmark, *observation);
            }
        }
        for l in &self.landmarks {
            map.refresh_geometry(*l, config);
        }
        let mut moved: Vec<usize> = before.keys().flat_map(|k| map.with_carried(*k)).collect();
        moved.sort_unstable();
        moved
    }
}

/// Adjusts the window around `keyframe` at once.
pub fn adjust_window(map: &mut Map, keyframe: usize, rig: &Rig) {
    let Rig { pinhole, config, .. } = rig;
    if let Some(mut window) = Adjustment::of_window(map, keyframe, rig) {
        window.solve(pinhole, config.bundle_iterations);
        window.apply(map, config);
    }
}

/// Keyframes that move (`keyframe` among them) and keyframes that hold them.
fn choose_window(map: &Map, keyframe: usize, config: &TrackingConfig) -> (Vec<usize>, Vec<usize>) {
    let neighbours = map.covisible(keyframe).into_iter().filter(|(_, shared)| *shared >= MIN_SHARED).map(|(k, _)| k);
    let references = |k: &usize| map.relative_poses(*k).map(|relative| relative.reference);
    let mut free = distinct(std::iter::once(keyframe).chain(references(&keyframe)).chain(neighbours));
    free.truncate(config.window_keyframes);
    free.retain(|k| !map.is_root(*k));
    let mut others = map.covisibility(map.landmarks_of(&free).into_iter());
    others.retain(|(k, _)| !free.contains(k));
    let mut fixed = distinct(free.iter().flat_map(references).filter(|k| !free.contains(k)));
    // By a few landmarks, some of them false, the window would be torn from its place: its oldest keyframe holds it.
    let holds = !fixed.is_empty() || others.first().is_some_and(|(_, shared)| *shared >= MIN_SHARED);
    let oldest = free.iter().copied().min().filter(|_| !holds);
    free.retain(|k| Some(*k) != oldest);
    fixed = distinct(oldest.into_iter().chain(fixed).chain(others.into_iter().map(|(k, _)| k)));
    fixed.truncate(MAX_FIXED);
    (free, fixed)
}

fn make_problem(
    map: &Map,
    keyframes: &[usize],
    free_poses: usize,
    landmarks: &[usize],
    rig: &Rig,
) -> (BundleProblem, Vec<Option<Observation>>) {
    let place: BTreeMap<usize, usize> = keyframes.iter().enumerate().map(|(i, k)| (*k, i)).collect();
    let mut problem = BundleProblem {
        poses: keyframes.iter().map(|k| map.keyframes[*k].camera_from_world).collect(),
        free_poses,
        points: landmarks.iter().map(|l| map.position(*l)).collect(),
        depth_bias: rig.depth_bias,
        ..Default::default()
    };
    for (k, current) in &place {
        let measured = map.relative_poses(*k).filter_map(|relative| Some((relative, *place.get(&relative.reference)?)));
        problem.relative_poses.extend(measured.map(|(relative, reference)| RelativePose {
            current: *current,
            reference,
            ..*relative
        }));
    }
    let mut observations = Vec::new();
    for (point, l) in landmarks.iter().enumerate() {
        for observation in &map.landmarks[*l].observations {
            let Some(&pose) = place.get(&observation.keyframe) else { continue };
            let measurement = rig.biased_measurement(&map.keyframes[observation.keyframe].features.features[observation.feature]);
            problem.observations.push(BundleObservation::new(pose, point, measurement));
            observations.push(Some(*observation));
        }
    }
    (problem, observations)
}

#[cfg(test)]
#[path = "local_bundle_tests.rs"]
mod tests;
