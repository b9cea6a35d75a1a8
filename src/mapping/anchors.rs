//! Which keyframe each Gaussian was seeded from: when a closed loop moves a keyframe, its Gaussians go with it.

use std::collections::BTreeMap;
use std::ops::Range;

use super::KeyframeId;
use crate::geometry::Se3;

/// A keyframe that moves by less than both was only refined, and optimisation takes its Gaussians along; a loop moves it further.
const MIN_SHIFT_METRES: f64 = 0.01;
const MIN_TURN_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// The keyframe of each Gaussian, `[N]` in map order. Seeds are appended and pruning keeps the order, so a keyframe's Gaussians lie side
/// by side.
#[derive(Clone, Debug, Default)]
pub(super) struct Anchors {
    keyframes: Vec<KeyframeId>,
}

impl Anchors {
    /// The newest `count` Gaussians are of `keyframe`.
    pub fn append(&mut self, keyframe: KeyframeId, count: usize) {
        self.keyframes.extend(std::iter::repeat_n(keyframe, count));
    }

    /// Only the Gaussians at `chosen` are left.
    pub fn keep(&mut self, chosen: &[u32]) {
        self.keyframes = chosen.iter().map(|i| self.keyframes[*i as usize]).collect();
    }

    /// The runs of Gaussians whose keyframe is among `motions`, and each run's motion.
    pub fn moved(&self, motions: &BTreeMap<KeyframeId, Se3>) -> Vec<(Range<usize>, Se3)> {
        let mut runs = Vec::new();
        let mut first = 0;
        for run in self.keyframes.chunk_by(|a, b| a == b) {
            if let Some(motion) = motions.get(&run[0]) {
                runs.push((first..first + run.len(), *motion));
            }
            first += run.len();
        }
        runs
    }
}

/// new_from_old, how a world moves that is held by a camera; `None` if that is no more than a refinement.
pub(super) fn motion(old_world_from_camera: &Se3, new_world_from_camera: &Se3) -> Option<Se3> {
    let old_from_new = old_world_from_camera.inverse() * new_world_from_camera;
    let far = old_from_new.translation.vector.norm() > MIN_SHIFT_METRES || old_from_new.rotation.angle() > MIN_TURN_RAD;
    far.then(|| new_world_from_camera * old_world_from_camera.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector3};

    #[test]
    fn runs_follow_appending_and_pruning() {
        let mut anchors = Anchors::default();
        [(0, 4), (2, 3), (5, 2)].into_iter().for_each(|(keyframe, count)| anchors.append(keyframe, count));
        anchors.keep(&[0, 3, 4, 6, 8]);
        let shift = Se3::translation(1.0, 0.0, 0.0);
        let motions = BTreeMap::from([(2, shift), (5, shift), (7, shift)]);
        assert_eq!(anchors.moved(&motions), [(2..4, shift), (4..5, shift)]);
        assert!(anchors.moved(&BTreeMap::new()).is_empty());
    }

    #[test]
    fn what_a_camera_sees_moves_with_it_but_not_for_a_refinement() {
        let old = Se3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.4, 0.2));
        let new = old * Se3::new(Vector3::new(0.05, 0.0, 0.0), Vector3::new(0.0, 0.03, 0.0));
        let p_in_camera = Point3::new(0.3, -0.2, 2.0);
        let moved = motion(&old, &new).unwrap() * (old * p_in_camera);
        assert!((moved - new * p_in_camera).norm() < 1e-12);
        assert!(motion(&old, &(old * Se3::new(Vector3::new(0.0, 0.009, 0.0), Vector3::new(0.008, 0.0, 0.0)))).is_none());
        assert!(motion(&old, &(old * Se3::new(Vector3::zeros(), Vector3::new(0.01, 0.0, 0.0)))).is_some());
    }
}
