//! The keyframe that each Gaussian was inserted from: when a closed loop moves a keyframe, its Gaussians go with it.

use std::collections::{BTreeMap, BTreeSet};

use glam::Vec3;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::KeyframeId;
use crate::geometry::{Se3, Sim3};
use crate::render::{Plan, RunMotion};

/// A keyframe that has moved by less than each of these since its Gaussians did was only refined, and optimisation takes these along; a loop moves it
/// further.
const MIN_SHIFT_METRES: f64 = 0.01;
const MIN_TURN_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// As far as [`MIN_SHIFT_METRES`] at the two metres of a room.
const MIN_LOG_SCALE: f64 = 0.005;

/// The Gaussians' keyframes, `[N]` in map order. Inserted Gaussians are appended and pruning keeps the order, so most of a keyframe's Gaussians
/// lie side by side.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Anchors(Vec<KeyframeId>);

impl Anchors {
    /// The newest `count` Gaussians are of `keyframe`.
    pub fn append(&mut self, keyframe: KeyframeId, count: usize) {
        self.0.extend(std::iter::repeat_n(keyframe, count));
    }

    /// Follows a plan: children are of their parent's keyframe.
    pub fn apply(&mut self, plan: &Plan) {
        let children: Vec<KeyframeId> = plan.divided.iter().flat_map(|(parent, _)| [self.0[*parent as usize]; 2]).collect();
        // What lies between two that go moves up, as one piece.
        let ends = plan.removed.iter().skip(1).map(|i| *i as usize).chain([self.0.len()]);
        let mut kept = plan.removed.first().map_or(self.0.len(), |first| *first as usize);
        for (removed, end) in plan.removed.iter().zip(ends) {
            let piece = *removed as usize + 1..end;
            let length = piece.len();
            self.0.copy_within(piece, kept);
            kept += length;
        }
        self.0.truncate(kept);
        self.0.extend(children);
    }

    /// The Gaussians of some keyframes, ascending.
    pub fn of(&self, keyframes: &BTreeSet<KeyframeId>) -> Vec<u32> {
        (0..).zip(&self.0).filter(|(_, keyframe)| keyframes.contains(keyframe)).map(|(gaussian, _)| gaussian).collect()
    }

    /// Gaussians that come back, of these keyframes.
    pub fn put_back(&mut self, keyframes: &[KeyframeId]) {
        self.0.extend_from_slice(keyframes);
    }

    /// The keyframes of some Gaussians.
    pub fn at(&self, places: &[u32]) -> Vec<KeyframeId> {
        places.iter().map(|place| self.0[*place as usize]).collect()
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// The runs of Gaussians whose keyframe is among `motions`, ascending.
    pub fn moved(&self, motions: &BTreeMap<KeyframeId, Sim3>) -> Vec<RunMotion> {
        let mut runs = Vec::new();
        let mut first = 0;
        for run in self.0.chunk_by(|a, b| a == b) {
            if let Some(new_from_old) = motions.get(&run[0]) {
                runs.push(RunMotion { run: first..first + run.len(), new_from_old: *new_from_old });
            }
            first += run.len();
        }
        runs
    }
}

/// new_from_old, how a world moves that is held by a camera, when distances from the camera grow by a factor; `None` if that is no more
/// than a refinement.
pub(super) fn motion(old_world_from_camera: &Se3, new_world_from_camera: &Se3, scale: f64) -> Option<Sim3> {
    let old_from_new = old_world_from_camera.inverse() * new_world_from_camera;
    let far = is_beyond_refinement(old_from_new.translation.vector.norm(), old_from_new.rotation.angle(), scale);
    let world_from_old_camera = Sim3 { scale, ..Sim3::from(*new_world_from_camera) };
    far.then(|| world_from_old_camera * Sim3::from(*old_world_from_camera).inverse())
}

/// Whether a motion is more than a refinement of what is around a point of the new world: then moments belong to where the Gaussians were.
pub(super) fn is_far(new_from_old: &Sim3, point: Vec3) -> bool {
    let point = Point3::new(point.x, point.y, point.z).cast();
    let shift = new_from_old.inverse().act(&point) - point;
    is_beyond_refinement(shift.norm(), new_from_old.rotation.angle(), new_from_old.scale)
}

fn is_beyond_refinement(shift_metres: f64, turn_rad: f64, scale: f64) -> bool {
    shift_metres > MIN_SHIFT_METRES || turn_rad > MIN_TURN_RAD || scale.ln().abs() > MIN_LOG_SCALE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Division;
    use nalgebra::Vector3;

    #[test]
    fn runs_follow_appending_pruning_and_growing() {
        let mut anchors = Anchors::default();
        [(0, 4), (2, 3), (5, 2)].into_iter().for_each(|(keyframe, count)| anchors.append(keyframe, count));
        let divided = vec![(1, Division::Split), (5, Division::Clone)];
        anchors.apply(&Plan { removed: vec![1, 2, 5, 7], divided });
        assert_eq!(anchors.0, [0, 0, 2, 2, 5, 0, 0, 2, 2]);
        let new_from_old = Sim3::from(Se3::translation(1.0, 0.0, 0.0));
        let motions = [2, 5, 7].map(|keyframe| (keyframe, new_from_old)).into();
        assert_eq!(anchors.moved(&motions), [2..4, 4..5, 7..9].map(|run| RunMotion { run, new_from_old }));
        assert!(anchors.moved(&BTreeMap::new()).is_empty());
        assert_eq!(anchors.of(&[2, 5, 7].into()), [2, 3, 4, 7, 8]);
        anchors.apply(&Plan::removing(vec![0, 8]));
        assert_eq!(anchors.0, [0, 2, 2, 5, 0, 0, 2]);
        anchors.apply(&Plan::default());
        assert_eq!(anchors.len(), 7);
    }

    #[test]
    fn what_a_camera_sees_moves_with_it_but_not_for_a_refinement() {
        let old = Se3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.4, 0.2));
        let new = old * Se3::new(Vector3::new(0.05, 0.0, 0.0), Vector3::new(0.0, 0.03, 0.0));
        let p_in_camera = Point3::new(0.3, -0.2, 2.0);
        for scale in [1.0, 0.8, 1.3] {
            let moved = motion(&old, &new, scale).unwrap().act(&(old * p_in_camera));
            assert!((moved - new * (p_in_camera * scale)).norm() < 1e-12);
        }
        assert!(motion(&old, &(old * Se3::new(Vector3::new(0.0, 0.009, 0.0), Vector3::new(0.008, 0.0, 0.0))), 1.0).is_none());
        assert!(motion(&old, &(old * Se3::new(Vector3::zeros(), Vector3::new(0.01, 0.0, 0.0))), 1.0).is_some());
        for scale in [0.99, 1.01] {
            assert!(motion(&old, &old, scale).is_some() && motion(&old, &old, scale.powf(0.4)).is_none());
        }
    }

    #[test]
    fn a_shift_counts_only_beyond_its_threshold() {
        let shifted = |metres: f64| motion(&Se3::identity(), &Se3::translation(metres, 0.0, 0.0), 1.0);
        assert_eq!(shifted(MIN_SHIFT_METRES), None);
        assert_eq!(shifted(2.0 * MIN_SHIFT_METRES), Some(Se3::translation(2.0 * MIN_SHIFT_METRES, 0.0, 0.0).into()));
    }
}
