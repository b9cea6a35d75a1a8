//! Culled keyframes: each is attached rigidly to a living one, its parent, and goes where that goes.
//!
//! One keeps its id, frame and pose, and nothing that it saw: with its entry here it takes about 250 bytes.

use crate::geometry::Se3;
use crate::tracking::map::sparse_map::Map;

/// A culled keyframe, as its parent holds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CulledKeyframe {
    pub keyframe: usize,
    /// In the parent's unit of length.
    pub camera_from_parent: Se3,
}

impl Map {
    /// Whether a keyframe has been culled.
    pub fn is_culled(&self, keyframe: usize) -> bool {
        self.keyframes[keyframe].parent.is_some()
    }

    /// The keyframe itself if it lives, else the one that it goes with.
    pub fn living(&self, keyframe: usize) -> usize {
        self.keyframes[keyframe].parent.unwrap_or(keyframe)
    }

    /// The keyframe and the culled ones that go with it.
    pub fn with_carried(&self, keyframe: usize) -> impl Iterator<Item = usize> {
        let carried = self.carried.get(&keyframe).into_iter().flatten();
        std::iter::once(keyframe).chain(carried.map(|culled| culled.keyframe))
    }

    /// Moves a keyframe, with what hangs on it.
    pub fn set_pose(&mut self, keyframe: usize, mut camera_from_world: Se3) {
        // The inverse of a rotation that is not quite one would double the error with each correction.
        camera_from_world.rotation.renormalize();
        self.keyframes[keyframe].camera_from_world = camera_from_world;
        for culled in self.carried.get(&keyframe).into_iter().flatten() {
            let pose = self.keyframes[keyframe].carry(&culled.camera_from_parent);
            self.keyframes[culled.keyframe].camera_from_world = pose;
        }
    }

    /// Gives up a keyframe, which has no landmarks any more. It is attached to the first of `parents`, of which there is at least one; what it carries,
    /// to the nearest: each turn of a parent far away would move it far.
    pub fn attach(&mut self, keyframe: usize, parents: &[usize]) {
        let nothing = self.no_features.clone();
        let given_up = &mut self.keyframes[keyframe];
        let features = std::mem::replace(&mut given_up.features, nothing);
        (given_up.links, given_up.neighbours) = (Vec::new(), Vec::new());
        (given_up.relative_poses, given_up.landmarks) = (Vec::new(), Vec::new());
        self.dense_bytes -= given_up.dense.take().map_or(0, |dense| dense.bytes());
        self.database.remove(keyframe, &features.features);
        self.living.remove(&keyframe);
        self.features -= features.len();
        let moved: Vec<usize> = self.with_carried(keyframe).collect();
        self.carried.remove(&keyframe);
        for (k, keyframe) in moved.into_iter().enumerate() {
            let centre = self.keyframes[keyframe].centre();
            let distance = |parent: &usize| (self.keyframes[*parent].centre() - centre).norm_squared();
            let nearest = || parents.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let Some(parent) = (if k == 0 { parents.first() } else { nearest() }).copied() else { return };
            let camera_from_parent = self.keyframes[parent].relative(&self.keyframes[keyframe].camera_from_world);
            self.keyframes[keyframe].parent = Some(parent);
            self.carried.entry(parent).or_default().push(CulledKeyframe { keyframe, camera_from_parent });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    use nalgebra::Point3;

    use crate::tracking::map::sparse_map::tests::{at, config, map};

    #[test]
    fn what_hangs_on_a_keyframe_goes_with_it() {
        let mut map = map();
        let id = map.add_landmark(at(1, 1), Point3::new(0.5, 0.0, 2.0), &config());
        map.add_observation(id, at(2, 4));
        map.keyframes[1].unit = 2.0;
        map.set_position(id, &Point3::new(0.5, 0.0, 2.0));
        map.attach(0, &[1]);
        let push = Se3::translation(0.0, 0.3, 0.0);
        map.set_pose(1, push);
        assert!((map.position(id) - Point3::new(0.5, -0.3, 2.0)).norm() < 1e-12);
        assert!((map.keyframes[0].centre() - map.keyframes[1].centre()).norm() < 1e-12 && map.living(0) == 1);
        // Its next anchor takes it over where it is.
        map.remove_observation(id, at(1, 1));
        map.set_pose(1, Se3::identity());
        assert!((map.position(id) - Point3::new(0.5, -0.3, 2.0)).norm() < 1e-12 && map.landmarks[id].anchor == 2);
    }

    #[test]
    fn what_a_culled_keyframe_carried_goes_with_the_nearest() {
        let mut map = map();
        let near = map.push(map.keyframes[2].clone());
        map.set_pose(2, Se3::translation(0.0, 0.0, 5.0));
        map.attach(0, &[1]);
        map.attach(1, &[2, near]);
        assert_eq!((map.living(1), map.living(0)), (2, near));
    }

    #[test]
    fn a_culled_keyframe_keeps_no_memory_of_what_it_saw() {
        let mut map = map();
        map.attach(0, &[1]);
        map.attach(1, &[2]);
        for culled in &map.keyframes[..2] {
            assert_eq!((culled.landmarks.capacity(), culled.links.capacity(), culled.parent), (0, 0, Some(2)));
            assert!(Arc::ptr_eq(&culled.features, &map.no_features));
        }
        assert_eq!(map.with_carried(2).collect::<Vec<_>>(), [2, 1, 0]);
        assert!(map.carried.len() == 1 && map.is_culled(0) && !map.is_culled(2));
    }
}
