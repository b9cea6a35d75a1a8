//! The keyframe that each Gaussian was inserted from, and whether steps move it: when a correction moves a keyframe, its Gaussians go with it.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::KeyframeId;
use crate::geometry::Sim3;
use crate::render::{Motions, Plan};

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

    /// The Gaussians whose keyframe has moved, new_from_old each.
    pub fn moved(&self, each: &BTreeMap<KeyframeId, Sim3>) -> Motions {
        let mut runs = Vec::new();
        let mut first = 0;
        let places: BTreeMap<KeyframeId, usize> = each.keys().copied().zip(0..).collect();
        for run in self.0.chunk_by(|a, b| a.keyframe() == b.keyframe()) {
            let motion = places.get(&run[0].keyframe());
            runs.extend(motion.map(|motion| (first..first + run.len(), *motion)));
            first += run.len();
        }
        Motions { of: each.values().copied().collect(), runs }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;
    use crate::render::Division;

    #[test]
    fn runs_follow_appending_pruning_and_growing() {
        let mut anchors = Anchors::default();
        [(0, 4), (2, 3), (5, 2)].into_iter().for_each(|(keyframe, count)| anchors.append(keyframe, count));
        let divided = vec![(1, Division::Split), (5, Division::Clone)];
        anchors.apply(&Plan { removed: vec![1, 2, 5, 7], divided });
        let keyframes = |anchors: &Anchors| anchors.at(&(0..anchors.len() as u32).collect::<Vec<_>>());
        assert_eq!(keyframes(&anchors), [0, 0, 2, 2, 5, 0, 0, 2, 2]);
        let by = |metres: f64| Sim3::from(Se3::translation(metres, 0.0, 0.0));
        let each = [(2, by(1.0)), (5, by(2.0)), (7, by(3.0))].into();
        let moved = Motions { of: vec![by(1.0), by(2.0), by(3.0)], runs: vec![(2..4, 0), (4..5, 1), (7..9, 0)] };
        assert_eq!((anchors.moved(&each), moved.gaussians()), (moved, 5));
        assert!(anchors.moved(&BTreeMap::new()).runs.is_empty());
        anchors.fix(&[3, 8]);
        assert_eq!(anchors.moved(&each).runs, [(2..4, 0), (4..5, 1), (7..9, 0)]);
        assert_eq!(anchors.of(&[2, 5, 7].into()), [2, 3, 4, 7, 8]);
        anchors.apply(&Plan::removing(vec![0, 7]));
        assert_eq!((keyframes(&anchors), anchors.fixed().collect()), (vec![0, 2, 2, 5, 0, 0, 2], vec![2, 6]));
        anchors.apply(&Plan::default());
        assert_eq!(anchors.len(), 7);
    }
}
