//! The sparse map: keyframes, landmarks, who sees what, and the covisibility that follows from it.
//!
//! Everything is indexed by its place in a `Vec`, so every walk has one order. The place of a landmark that ended is used again when no frame can name
//! it any more; who names landmarks for longer checks by which keyframe they were made. A culled keyframe
//! keeps its place and its pose, and nothing else. No walk but a correction's is over all of them: what a frame or a keyframe costs depends on what
//! it sees, and on the culled keyframes that follow those it moves.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use nalgebra::{Point3, Vector3};

use crate::geometry::Se3;
use crate::tracking::TrackingConfig;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::map::attachment::CulledKeyframe;
pub use crate::tracking::map::keyframe::Keyframe;
use crate::tracking::map::keyframe_database::KeyframeDatabase;
pub use crate::tracking::map::landmark::{Landmark, LandmarkState, Observation};
use crate::tracking::map::tally::{distinct, tally};
use crate::tracking::map::trim;
use crate::tracking::solvers::relative_pose::RelativePose;

/// Links that a keyframe keeps, and neighbours.
const MOST_LINKS: usize = 5;
/// Keyframes after a frame's reference until the frame's pose is solved again.
pub const SETTLED_AFTER: usize = 12;
/// Keyframes after the end of a landmark until its place is used again: later than frames without measured depth are solved again. Those that wait
/// longer name landmarks by [`Map::resolve_since`].
const REUSED_AFTER: usize = SETTLED_AFTER + 4;
/// Host memory of a keyframe's feature: itself, its place in the grid, the landmark that it shows, the observation, its entry in the database.
const BYTES_PER_FEATURE: usize = size_of::<Feature>() + 12 + size_of::<Option<usize>>() + 2 * size_of::<Observation>() + 48;
const BYTES_PER_LANDMARK: usize = size_of::<Landmark>();

#[derive(Clone, Debug, Default)]
pub struct Map {
    pub keyframes: Vec<Keyframe>,
    pub landmarks: Vec<Landmark>,
    /// By which keyframes are recognised.
    pub database: KeyframeDatabase,
    /// The culled keyframes that each living one carries.
    pub(super) carried: BTreeMap<usize, Vec<CulledKeyframe>>,
    /// What culled keyframes have.
    pub(super) no_features: Arc<FrameFeatures>,
    /// Counts corrections of the whole map: what was computed before one does not fit what is after it.
    pub corrections: usize,
    /// First keyframes of submaps that have not joined another.
    pub roots: BTreeSet<usize>,
    /// Keyframes that have not been culled, how many features they hold, and bytes of their pixels.
    pub living: BTreeSet<usize>,
    pub(super) features: usize,
    pub(super) dense_bytes: usize,
    /// Landmarks on probation and the keyframes that made them, oldest first.
    pub probation: VecDeque<(usize, usize)>,
    /// Landmarks that are no more, and the number of keyframes when they ended, oldest first: their places are used again.
    ended: VecDeque<(usize, usize)>,
}

impl Map {
    /// Takes in another map's keyframes and landmarks; nothing connects them with those that are here.
    pub fn append(&mut self, other: Self, world_from_other: &Se3, config: &TrackingConfig) {
        debug_assert!(other.carried.is_empty(), "maps are appended before anything is culled");
        let (keyframes, landmarks) = (self.keyframes.len(), self.landmarks.len());
        let other_from_world = world_from_other.inverse();
        for mut keyframe in other.keyframes {
            keyframe.root += keyframes;
            keyframe.camera_from_world *= other_from_world;
            keyframe.neighbours.iter_mut().for_each(|k| *k += keyframes);
            keyframe.landmarks.iter_mut().flatten().for_each(|l| *l += landmarks);
            for relative in &mut keyframe.relative_poses {
                relative.current += keyframes;
                relative.reference += keyframes;
            }
            self.push(keyframe);
        }
        for mut landmark in other.landmarks {
            landmark.anchor += keyframes;
            landmark.first_keyframe += keyframes;
            landmark.observations.iter_mut().for_each(|o| o.keyframe += keyframes);
            if let LandmarkState::MergedInto(into) = &mut landmark.state {
                *into += landmarks;
            }
            self.landmarks.push(landmark);
        }
        self.probation.extend(other.probation.iter().map(|(l, by)| (l + landmarks, by + keyframes)));
        self.ended.extend(other.ended.iter().map(|(l, _)| (l + landmarks, self.keyframes.len())));
        (landmarks..self.landmarks.len()).for_each(|l| self.refresh_geometry(l, config));
    }

    /// Takes in a keyframe, the newest, and returns its id.
    pub fn push(&mut self, mut keyframe: Keyframe) -> usize {
        let id = self.keyframes.len();
        self.database.insert(id, &keyframe.features.features);
        self.living.insert(id);
        self.features += keyframe.features.len();
        self.dense_bytes += keyframe.dense.as_ref().map_or(0, |dense| dense.bytes());
        if keyframe.root == id {
            self.roots.insert(id);
        }
        if let Some(last) = self.keyframes.last() {
            keyframe.travelled = last.travelled;
            if last.root == keyframe.root {
                let step = keyframe.camera_from_world * last.camera_from_world.inverse();
                keyframe.travelled.metres += step.translation.vector.norm();
                keyframe.travelled.radians += step.rotation.angle();
            }
        }
        self.keyframes.push(keyframe);
        id
    }

    /// A landmark's place in the world, metres.
    pub fn position(&self, landmark: usize) -> Point3<f64> {
        let l = &self.landmarks[landmark];
        let anchor = &self.keyframes[l.anchor];
        anchor.camera_from_world.inverse_transform_point(&(l.in_anchor * anchor.unit))
    }

    /// Moves a landmark to a place in the world, metres.
    pub fn set_position(&mut self, landmark: usize, position: &Point3<f64>) {
        let anchor = &self.keyframes[self.landmarks[landmark].anchor];
        self.landmarks[landmark].in_anchor = (anchor.camera_from_world * position) / anchor.unit;
    }

    /// A landmark first seen by `observation`.
    pub fn add_landmark(&mut self, observation: Observation, position: Point3<f64>, config: &TrackingConfig) -> usize {
        let may_reuse = self.ended.front().is_some_and(|(_, at)| *at + REUSED_AFTER <= self.keyframes.len());
        let free = if may_reuse { self.ended.pop_front() } else { None };
        let landmark = Landmark {
            anchor: observation.keyframe,
            in_anchor: Point3::origin(),
            descriptor: self.keyframes[observation.keyframe].features.features[observation.feature].descriptor,
            view_direction: Vector3::z(),
            range: (0.0, f64::INFINITY),
            observations: vec![observation],
            first_keyframe: observation.keyframe,
            observable: 1,
            observed: 1,
            state: LandmarkState::Alive,
        };
        let id = free.map_or(self.landmarks.len(), |(id, _)| id);
        if id == self.landmarks.len() {
            self.landmarks.push(landmark);
        } else {
            self.landmarks[id] = landmark;
        }
        self.probation.push_back((id, observation.keyframe));
        self.keyframes[observation.keyframe].landmarks[observation.feature] = Some(id);
        self.set_position(id, &position);
        self.refresh_geometry(id, config);
        id
    }

    /// Records that a keyframe sees a landmark. Nothing changes if either is already spoken for.
    pub fn add_observation(&mut self, landmark: usize, observation: Observation) {
        let slot = &mut self.keyframes[observation.keyframe].landmarks[observation.feature];
        if slot.is_none() && !self.landmarks[landmark].seen_by(observation.keyframe) {
            *slot = Some(landmark);
            self.landmarks[landmark].observations.push(observation);
        }
    }

    /// Takes a observation back; a landmark that nobody sees any more is removed.
    pub fn remove_observation(&mut self, landmark: usize, observation: Observation) {
        self.keyframes[observation.keyframe].landmarks[observation.feature] = None;
        let observations = &mut self.landmarks[landmark].observations;
        observations.retain(|s| *s != observation);
        trim(observations);
        match self.landmarks[landmark].observations.first() {
            Some(first) => self.hang_on(landmark, first.keyframe),
            None => self.end(landmark, LandmarkState::Removed),
        }
    }

    /// Makes a keyframe a landmark's anchor; the landmark stays where it is.
    fn hang_on(&mut self, landmark: usize, anchor: usize) {
        let before = self.landmarks[landmark].anchor;
        if before == anchor {
            return;
        }
        let position = self.position(landmark);
        let (old, new) = (&self.keyframes[before], &self.keyframes[anchor]);
        let turned = new.camera_from_world.rotation * old.camera_from_world.rotation.inverse();
        let l = &mut self.landmarks[landmark];
        l.anchor = anchor;
        l.view_direction = turned * l.view_direction;
        self.set_position(landmark, &position);
    }

    pub fn remove_landmark(&mut self, landmark: usize) {
        for observation in std::mem::take(&mut self.landmarks[landmark].observations) {
            self.keyframes[observation.keyframe].landmarks[observation.feature] = None;
        }
        self.end(landmark, LandmarkState::Removed);
    }

    fn end(&mut self, landmark: usize, state: LandmarkState) {
        self.landmarks[landmark].state = state;
        self.ended.push_back((landmark, self.keyframes.len()));
    }

    /// Whether a landmark is alive and the one that went by this id when there were `known` keyframes.
    pub fn is_alive_since(&self, landmark: usize, known: usize) -> bool {
        let l = &self.landmarks[landmark];
        l.state == LandmarkState::Alive && l.first_keyframe < known
    }

    /// Host memory of what tracking keeps of keyframes and landmarks, bytes, by their number and pixels.
    pub fn bytes(&self) -> u64 {
        (self.features * BYTES_PER_FEATURE + self.landmarks.len() * BYTES_PER_LANDMARK + self.dense_bytes) as u64
    }

    /// `from` is the same point as `into`, which takes over its observations.
    pub fn merge(&mut self, from: usize, into: usize) {
        if from == into
            || self.landmarks[from].state != LandmarkState::Alive
            || self.landmarks[into].state != LandmarkState::Alive
        {
            return;
        }
        for observation in std::mem::take(&mut self.landmarks[from].observations) {
            self.keyframes[observation.keyframe].landmarks[observation.feature] = None;
            self.add_observation(into, observation);
        }
        let (observable, observed) = (self.landmarks[from].observable, self.landmarks[from].observed);
        self.end(from, LandmarkState::MergedInto(into));
        self.landmarks[into].observable += observable;
        self.landmarks[into].observed += observed;
    }

    /// The living landmark that `landmark` has become, if any.
    pub fn resolve(&self, landmark: usize) -> Option<usize> {
        let mut id = landmark;
        loop {
            match self.landmarks[id].state {
                LandmarkState::Alive => return Some(id),
                LandmarkState::Removed => return None,
                LandmarkState::MergedInto(next) => id = next,
            }
        }
    }

    /// The living landmark that has become of the one that went by this id when there were `known` keyframes, if any. Places are used again in the
    /// order in which they became free: while the first landmark of a chain keeps its place, so do those into which it was merged.
    pub fn resolve_since(&self, landmark: usize, known: usize) -> Option<usize> {
        if self.landmarks[landmark].first_keyframe < known { self.resolve(landmark) } else { None }
    }

    /// Keyframes that see the given landmarks and how many of them, most first, then newest first.
    pub fn covisibility(&self, landmarks: impl Iterator<Item = usize>) -> Vec<(usize, usize)> {
        let seen = landmarks.flat_map(|l| self.landmarks[l].observations.iter().map(|s| s.keyframe));
        let mut ranked = tally(seen);
        ranked.sort_by_key(|(keyframe, count)| (std::cmp::Reverse(*count), std::cmp::Reverse(*keyframe)));
        ranked
    }

    /// Keyframes that share landmarks with a keyframe and how many, strongest first.
    pub fn covisible(&self, keyframe: usize) -> Vec<(usize, usize)> {
        let mut ranked = self.covisibility(self.keyframes[keyframe].landmarks.iter().flatten().copied());
        ranked.retain(|(other, _)| *other != keyframe);
        ranked
    }

    /// A keyframe's measured poses relative to older keyframes that have not been culled.
    pub fn relative_poses(&self, keyframe: usize) -> impl Iterator<Item = &RelativePose> {
        self.keyframes[keyframe].relative_poses.iter().filter(|relative| self.living.contains(&relative.reference))
    }

    /// The keyframes of a submap that have not been culled, in ascending order.
    pub fn living_in(&self, root: usize) -> impl Iterator<Item = usize> {
        self.living.iter().copied().filter(move |k| self.keyframes[*k].root == root)
    }

    /// Whether all keyframes are of one submap.
    pub fn is_connected(&self) -> bool {
        self.roots.len() <= 1
    }

    /// Whether two keyframes are of one submap.
    pub fn connects(&self, a: usize, b: usize) -> bool {
        self.keyframes[a].root == self.keyframes[b].root
    }

    /// Whether a keyframe is the first of its submap, which never moves by itself.
    pub fn is_root(&self, keyframe: usize) -> bool {
        self.keyframes[keyframe].root == keyframe
    }

    /// Notes which keyframes share most landmarks with a keyframe; returns all that do, as [`Self::covisible`].
    pub fn refresh_neighbours(&mut self, keyframe: usize) -> Vec<(usize, usize)> {
        let covisible = self.covisible(keyframe);
        self.keyframes[keyframe].neighbours = covisible.iter().map(|(other, _)| *other).take(MOST_LINKS).collect();
        covisible
    }

    /// Notes which keyframes share most landmarks with a keyframe, and which of the older ones do.
    pub fn refresh_links(&mut self, keyframe: usize) {
        let older = self.refresh_neighbours(keyframe).into_iter().filter(|(other, _)| *other < keyframe);
        self.keyframes[keyframe].links = older.take(MOST_LINKS).collect();
    }

    /// Median depth of the landmarks that a keyframe sees, metres.
    pub fn median_depth(&self, keyframe: usize) -> Option<f64> {
        let view = &self.keyframes[keyframe];
        let depth = |l: &usize| (view.camera_from_world * self.position(*l)).z;
        let mut depths: Vec<f64> = view.landmarks.iter().flatten().map(depth).collect();
        depths.sort_by(f64::total_cmp);
        depths.get(depths.len() / 2).copied()
    }

    /// The landmarks of some keyframes, each once, in order of first mention.
    pub fn landmarks_of(&self, keyframes: &[usize]) -> Vec<usize> {
        distinct(keyframes.iter().flat_map(|k| self.keyframes[*k].landmarks.iter().flatten().copied()))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    use crate::tracking::features::descriptor::Descriptor;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    pub fn config() -> TrackingConfig {
        TrackingConfig::default()
    }

    /// Three keyframes of ten features each, at one place.
    pub fn map() -> Map {
        let list = (0..10).map(|i| feature(50.0 * f64::from(i), 100.0, Descriptor([1 << i, 0, 0, 0]))).collect();
        let features = Arc::new(FrameFeatures::new(list, &PINHOLE));
        let keyframe = Keyframe::new(0, 0.0, Se3::identity(), features);
        let mut map = Map::default();
        (0..3).for_each(|_| _ = map.push(keyframe.clone()));
        map
    }

    pub fn at(keyframe: usize, feature: usize) -> Observation {
        Observation { keyframe, feature }
    }

    #[test]
    fn merging_moves_sightings_and_keeps_both_sides_in_step() {
        let mut map = map();
        let a = map.add_landmark(at(0, 1), Point3::new(0.0, 0.0, 2.0), &config());
        let b = map.add_landmark(at(1, 2), Point3::new(0.0, 0.0, 2.0), &config());
        map.add_observation(b, at(2, 3));
        map.add_observation(b, at(2, 4)); // a second one in the same keyframe
        assert_eq!(map.covisible(1), [(2, 1)]);
        map.merge(b, a);
        assert_eq!(map.resolve(b), Some(a));
        assert_eq!(map.landmarks[a].observations, [at(0, 1), at(1, 2), at(2, 3)]);
        assert_eq!((map.keyframes[1].landmarks[2], map.keyframes[2].landmarks[4]), (Some(a), None));
        assert_eq!(map.covisible(0), [(2, 1), (1, 1)]);
        map.remove_observation(a, at(0, 1));
        map.remove_landmark(a);
        assert_eq!(map.resolve(b), None);
        assert!(map.keyframes.iter().all(|k| k.landmarks.iter().all(Option::is_none)));
    }

    #[test]
    fn observations_that_are_gone_leave_no_memory_behind() {
        let mut map = map();
        let landmark = map.add_landmark(at(0, 1), Point3::new(0.0, 0.0, 2.0), &config());
        (0..60).for_each(|_| _ = map.push(map.keyframes[0].clone()));
        (3..60).for_each(|k| map.keyframes[k].landmarks = vec![None; 10]);
        (3..60).for_each(|k| map.add_observation(landmark, at(k, 1)));
        (4..60).for_each(|k| map.remove_observation(landmark, at(k, 1)));
        let observations = &map.landmarks[landmark].observations;
        assert!(observations[..] == [at(0, 1), at(3, 1)] && observations.capacity() <= 4, "{}", observations.capacity());
    }

    #[test]
    fn the_place_of_a_landmark_that_ended_is_used_again_when_nobody_names_it() {
        let mut map = map();
        let first = map.add_landmark(at(0, 1), Point3::new(0.0, 0.0, 2.0), &config());
        let known = map.keyframes.len();
        map.remove_landmark(first);
        let second = map.add_landmark(at(1, 2), Point3::new(0.0, 1.0, 2.0), &config());
        assert_ne!(first, second);
        (0..REUSED_AFTER).for_each(|_| _ = map.push(map.keyframes[0].clone()));
        let third = map.add_landmark(at(4, 3), Point3::new(1.0, 0.0, 2.0), &config());
        assert_eq!((third, map.landmarks.len()), (first, 2));
        assert!(map.is_alive_since(second, known) && !map.is_alive_since(third, known));
        assert_eq!(map.position(third), Point3::new(1.0, 0.0, 2.0));
    }
}
