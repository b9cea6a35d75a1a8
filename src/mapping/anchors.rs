//! The keyframe that each Gaussian was inserted from, and whether steps move it: when a closed loop moves a keyframe, its Gaussians go with it.

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

/// Keyframe of a Gaussian; the highest bit is set where no step moves the Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Anchor(u32);

const FIXED: u32 = 1 << 31;

impl Anchor {
    /// Of a Gaussian that steps move.
    fn new(keyframe: KeyframeId) -> Self {
        Self(u32::try_from(keyframe).ok().filter(|id| id & FIXED == 0).expect("a recording has fewer than 2³¹ keyframes"))
    }

    fn keyframe(self) -> KeyframeId {
        (self.0 & !FIXED) as KeyframeId
    }

    fn is_fixed(self) -> bool {
        self.0 & FIXED != 0
    }
}

/// What the mapper knows of each Gaussian, `[N]` in map order. Inserted Gaussians are appended and pruning keeps the order, so most of a keyframe's
/// Gaussians lie side by side.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Anchors(Vec<Anchor>);

impl Anchors {
    /// The newest `count` Gaussians are of `keyframe`.
    pub fn append(&mut self, keyframe: KeyframeId, count: usize) {
        self.0.resize(self.0.len() + count, Anchor::new(keyframe));
    }

    /// Gaussians that come back, of these keyframes.
    pub fn put_back(&mut self, keyframes: &[KeyframeId]) {
        self.0.extend(keyframes.iter().map(|keyframe| Anchor::new(*keyframe)));
    }

    /// Follows a plan: children are as their parent, and what lies between two that go moves up as one piece.
    pub fn apply(&mut self, plan: &Plan) {
        let each = &mut self.0;
        let children: Vec<Anchor> = plan.divided.iter().flat_map(|(parent, _)| [each[*parent as usize]; 2]).collect();
        let ends = plan.removed.iter().skip(1).map(|i| *i as usize).chain([each.len()]);
        let mut kept = plan.removed.first().map_or(each.len(), |first| *first as usize);
        for (removed, end) in plan.removed.iter().zip(ends) {
            let piece = *removed as usize + 1..end;
            let length = piece.len();
            each.copy_within(piece, kept);
            kept += length;
        }
        each.truncate(kept);
        each.extend(children);
    }

    /// The Gaussians of some keyframes, ascending.
    pub fn of(&self, keyframes: &BTreeSet<KeyframeId>) -> Vec<u32> {
        self.places(|anchor| keyframes.contains(&anchor.keyframe())).collect()
    }

    /// The keyframes of some Gaussians.
    pub fn at(&self, places: &[u32]) -> Vec<KeyframeId> {
        places.iter().map(|place| self.keyframe(*place)).collect()
    }

    /// The keyframe of a Gaussian.
    pub fn keyframe(&self, place: u32) -> KeyframeId {
        self.0[place as usize].keyframe()
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// No step moves the Gaussians at these places from now on, and only these.
    pub fn fix(&mut self, places: &[u32]) {
        self.0.iter_mut().for_each(|anchor| anchor.0 &= !FIXED);
        places.iter().for_each(|place| self.0[*place as usize].0 |= FIXED);
    }

    /// Those that no step moves, ascending.
    pub fn fixed(&self) -> impl Iterator<Item = u32> + '_ {
        self.places(|anchor| anchor.is_fixed())
    }

    fn places(&self, which: impl Fn(Anchor) -> bool) -> impl Iterator<Item = u32> {
        (0..).zip(&self.0).filter(move |(_, anchor)| which(**anchor)).map(|(place, _)| place)
    }

    /// The runs of Gaussians whose keyframe has moved, ascending. Those that steps move follow `motions`, beyond a refinement; the fixed ones, which
    /// no step takes along, follow `each`.
    pub fn moved(&self, motions: &BTreeMap<KeyframeId, Sim3>, each: &BTreeMap<KeyframeId, Sim3>) -> Vec<RunMotion> {
        let mut runs = Vec::new();
        let mut first = 0;
        for run in self.0.chunk_by(|a, b| a == b) {
            let keyframe = run[0].keyframe();
            let motion = if run[0].is_fixed() { each } else { motions }.get(&keyframe);
            let clears_moments = motions.contains_key(&keyframe);
            runs.extend(motion.map(|motion| RunMotion { run: first..first + run.len(), new_from_old: *motion, clears_moments }));
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
        let keyframes = |anchors: &Anchors| anchors.at(&(0..anchors.len() as u32).collect::<Vec<_>>());
        assert_eq!(keyframes(&anchors), [0, 0, 2, 2, 5, 0, 0, 2, 2]);
        let new_from_old = Sim3::from(Se3::translation(1.0, 0.0, 0.0));
        let motions = [2, 5, 7].map(|keyframe| (keyframe, new_from_old)).into();
        let none = BTreeMap::new();
        let run = |clears_moments| move |run| RunMotion { run, new_from_old, clears_moments };
        assert_eq!(anchors.moved(&motions, &none), [2..4, 4..5, 7..9].map(run(true)));
        assert!(anchors.moved(&none, &motions).is_empty());
        anchors.fix(&[3, 8]);
        assert_eq!(anchors.moved(&motions, &none), [2..3, 4..5, 7..8].map(run(true)));
        assert_eq!(anchors.moved(&none, &motions), [3..4, 8..9].map(run(false)));
        assert_eq!(anchors.moved(&motions, &motions), [2..3, 3..4, 4..5, 7..8, 8..9].map(run(true)));
        assert_eq!(anchors.of(&[2, 5, 7].into()), [2, 3, 4, 7, 8]);
        anchors.apply(&Plan::removing(vec![0, 7]));
        assert_eq!((keyframes(&anchors), anchors.fixed().collect()), (vec![0, 2, 2, 5, 0, 0, 2], vec![2, 6]));
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
