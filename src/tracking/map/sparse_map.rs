//! The sparse map: keyframes, landmarks, who sees what, and the covisibility that follows from it.
//!
//! Everything is indexed by its place in a `Vec` (ids never change and are never reused), so every walk has one order. A culled keyframe
//! keeps its place and its pose, and nothing else. No walk but a correction's is over all of them: what a frame or a keyframe costs depends on what
//! it sees.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Point3, Vector3};

use crate::geometry::Se3;
use crate::tracking::TrackingConfig;
use crate::tracking::features::descriptor::{Descriptor, representative};
use crate::tracking::features::projection::Projection;
pub use crate::tracking::map::keyframe::{CulledKeyframe, Keyframe};
use crate::tracking::map::keyframe_database::KeyframeDatabase;
pub use crate::tracking::map::landmark::{Landmark, LandmarkState, Observation};
use crate::tracking::map::tally::{distinct, tally};
use crate::tracking::rig::Rig;

/// A landmark is looked for only within 60° of the mean direction from which it was seen.
const MIN_VIEW_COSINE: f64 = 0.5;
/// Slack on the range of distances at which the pyramid can see a landmark.
const RANGE_SLACK: f64 = 1.2;
/// A landmark's descriptor is chosen among those of its latest observations.
const DESCRIPTORS_COMPARED: usize = 10;
/// Links that a keyframe keeps.
const MOST_LINKS: usize = 5;

#[derive(Clone, Debug, Default)]
pub struct Map {
    pub keyframes: Vec<Keyframe>,
    pub landmarks: Vec<Landmark>,
    /// By which keyframes are recognised.
    pub database: KeyframeDatabase,
    /// By keyframe; none is held by another culled one.
    pub culled: BTreeMap<usize, CulledKeyframe>,
    /// The culled keyframes that each living one carries.
    carried: BTreeMap<usize, Vec<usize>>,
    /// Counts corrections of the whole map: what was computed before one does not fit what is after it.
    pub corrections: usize,
    /// First keyframes of submaps that have not joined another.
    pub roots: BTreeSet<usize>,
}

impl Map {
    /// Takes in another map's keyframes and landmarks; nothing connects them with those that are here.
    pub fn append(&mut self, other: Self, world_from_other: &Se3, config: &TrackingConfig) {
        let (keyframes, landmarks) = (self.keyframes.len(), self.landmarks.len());
        let other_from_world = world_from_other.inverse();
        for mut keyframe in other.keyframes {
            keyframe.root += keyframes;
            keyframe.camera_from_world *= other_from_world;
            keyframe.landmarks.iter_mut().flatten().for_each(|l| *l += landmarks);
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
        (landmarks..self.landmarks.len()).for_each(|l| self.refresh_geometry(l, config));
    }

    /// Takes in a keyframe, the newest, and returns its id.
    pub fn push(&mut self, mut keyframe: Keyframe) -> usize {
        let id = self.keyframes.len();
        self.database.insert(id, &keyframe.features.features);
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

    /// Moves a keyframe, with what hangs on it.
    pub fn set_pose(&mut self, keyframe: usize, mut camera_from_world: Se3) {
        // The inverse of a rotation that is not quite one would double the error with each correction.
        camera_from_world.rotation.renormalize();
        self.keyframes[keyframe].camera_from_world = camera_from_world;
        for culled in self.carried.get(&keyframe).into_iter().flatten() {
            let pose = self.keyframes[keyframe].carry(&self.culled[culled].camera_from_parent);
            self.keyframes[*culled].camera_from_world = pose;
        }
    }

    /// A landmark first seen by `observation`.
    pub fn add_landmark(&mut self, observation: Observation, position: Point3<f64>, config: &TrackingConfig) -> usize {
        let id = self.landmarks.len();
        self.landmarks.push(Landmark {
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
        });
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
        match self.landmarks[landmark].observations.first() {
            Some(first) => self.hang_on(landmark, first.keyframe),
            None => self.landmarks[landmark].state = LandmarkState::Removed,
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
        self.landmarks[landmark].state = LandmarkState::Removed;
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
        self.landmarks[from].state = LandmarkState::MergedInto(into);
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

    /// Chooses a landmark's descriptor among its latest observations.
    pub fn refresh_descriptor(&mut self, landmark: usize) {
        let latest = self.landmarks[landmark].observations.iter().rev().take(DESCRIPTORS_COMPARED);
        let descriptors: Vec<Descriptor> =
            latest.map(|s| self.keyframes[s.keyframe].features.features[s.feature].descriptor).collect();
        if let Some(descriptor) = representative(&descriptors) {
            self.landmarks[landmark].descriptor = descriptor;
        }
    }

    /// Works out again what follows from a landmark's position and observations: its direction and range.
    pub fn refresh_geometry(&mut self, landmark: usize, config: &TrackingConfig) {
        let l = &self.landmarks[landmark];
        let (Some(first), LandmarkState::Alive) = (l.observations.first(), l.state) else { return };
        let position = self.position(landmark);
        let mut direction = Vector3::zeros();
        for observation in &l.observations {
            let line = position - self.keyframes[observation.keyframe].centre();
            direction += line.try_normalize(1e-9).unwrap_or_default();
        }
        let anchor = &self.keyframes[first.keyframe];
        let scale = |octave: usize| config.pyramid_scale.powi(octave as i32);
        let octave = usize::from(anchor.features.features[first.feature].octave);
        let furthest = l.in_anchor.coords.norm() * scale(octave);
        let in_anchor = anchor.camera_from_world.rotation * direction;
        let view_direction = in_anchor.try_normalize(1e-9).unwrap_or(l.view_direction);
        let l = &mut self.landmarks[landmark];
        l.view_direction = view_direction;
        l.range = (furthest / scale(config.pyramid_levels - 1), furthest);
    }

    /// Projections of those landmarks that a camera should see, in their order; a projection's `point` is the landmark.
    pub fn visible(&self, landmarks: impl IntoIterator<Item = usize>, camera_from_world: &Se3, rig: &Rig) -> Vec<Projection> {
        landmarks.into_iter().filter_map(|landmark| self.predict(landmark, camera_from_world, rig)).collect()
    }

    /// Where a camera should see a landmark; `None` outside of its image, its range of distances or its viewing directions.
    fn predict(&self, landmark: usize, camera_from_world: &Se3, rig: &Rig) -> Option<Projection> {
        let Rig { pinhole, config } = rig;
        let l = &self.landmarks[landmark];
        let anchor = &self.keyframes[l.anchor];
        let p_in_camera = (camera_from_world * self.position(landmark)).coords;
        let pixel = pinhole.project(&p_in_camera).filter(|pixel| pinhole.contains(pixel, 0.0))?;
        let distance = p_in_camera.norm();
        let (nearest, furthest) = (l.range.0 * anchor.unit, l.range.1 * anchor.unit);
        if distance < nearest / RANGE_SLACK || distance > furthest * RANGE_SLACK {
            return None;
        }
        let line_of_sight = camera_from_world.rotation.inverse() * p_in_camera / distance;
        let view_cosine = line_of_sight.dot(&(anchor.camera_from_world.rotation.inverse() * l.view_direction));
        if view_cosine < MIN_VIEW_COSINE {
            return None;
        }
        let octave = ((furthest / distance).ln() / config.pyramid_scale.ln()).ceil();
        let octave = octave.clamp(0.0, config.pyramid_levels as f64 - 1.0) as u8;
        Some(Projection {
            point: landmark,
            pixel,
            octave,
            view_cosine,
            inverse_depth: 1.0 / p_in_camera.z,
            descriptor: l.descriptor,
            angle_rad: 0.0,
        })
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

    /// The keyframes of a submap that have not been culled, in ascending order.
    pub fn living_in(&self, root: usize) -> impl Iterator<Item = usize> {
        (0..self.keyframes.len()).filter(move |k| self.keyframes[*k].root == root && !self.culled.contains_key(k))
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

    /// The keyframe itself if it lives, else the one that it goes with.
    pub fn living(&self, keyframe: usize) -> usize {
        self.culled.get(&keyframe).map_or(keyframe, |held| held.parent)
    }

    /// The keyframe and the culled ones that go with it.
    pub fn with_carried(&self, keyframe: usize) -> impl Iterator<Item = usize> {
        std::iter::once(keyframe).chain(self.carried.get(&keyframe).into_iter().flatten().copied())
    }

    /// Attaches a keyframe, which has no landmarks any more, and what it carries to another one.
    pub fn attach(&mut self, keyframe: usize, parent: usize) {
        let carried = self.carried.remove(&keyframe).unwrap_or_default();
        for moved in std::iter::once(keyframe).chain(carried) {
            let camera_from_parent = self.keyframes[parent].relative(&self.keyframes[moved].camera_from_world);
            self.culled.insert(moved, CulledKeyframe { parent, camera_from_parent });
            self.carried.entry(parent).or_default().push(moved);
        }
    }

    /// Notes which older keyframes share most landmarks with a keyframe.
    pub fn refresh_links(&mut self, keyframe: usize) {
        let older = self.covisible(keyframe).into_iter().filter(|(other, _)| *other < keyframe);
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
mod tests {
    use super::*;
    use std::sync::Arc;

    use nalgebra::Vector2;

    use crate::tracking::features::frame_features::FrameFeatures;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    fn config() -> TrackingConfig {
        TrackingConfig::default()
    }

    /// Three keyframes of ten features each, at one place.
    fn map() -> Map {
        let list = (0..10).map(|i| feature(50.0 * f64::from(i), 100.0, Descriptor([1 << i, 0, 0, 0]))).collect();
        let features = Arc::new(FrameFeatures::new(list, &PINHOLE));
        let keyframe = Keyframe::new(0, 0.0, Se3::identity(), features);
        Map { keyframes: vec![keyframe; 3], ..Default::default() }
    }

    fn at(keyframe: usize, feature: usize) -> Observation {
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
    fn a_landmark_is_predicted_where_and_how_large_it_was_seen() {
        let mut map = map();
        let id = map.add_landmark(at(0, 1), Point3::new(0.0, 0.0, 2.0), &config());
        let predict = |pose: &Se3| map.predict(id, pose, &Rig { pinhole: PINHOLE, config: config() });
        let here = predict(&Se3::identity()).unwrap();
        assert_eq!((here.octave, here.inverse_depth), (0, 0.5));
        assert!((here.pixel - Vector2::new(320.5, 241.0)).norm() < 1e-9);
        // Half the distance shows it twice as large: 4 levels of 1.2 up.
        assert_eq!(predict(&Se3::translation(0.0, 0.0, -1.0)).unwrap().octave, 4);
        assert!(predict(&Se3::translation(0.0, 0.0, 2.0)).is_none(), "too small to see");
        assert!(predict(&Se3::translation(9.0, 0.0, 0.0)).is_none(), "out of the image");
        // From behind.
        let behind = Se3::new(Vector3::new(0.0, 0.0, 4.0), Vector3::y() * std::f64::consts::PI);
        assert!(predict(&behind).is_none());
    }
}
