//! What the mapper remembers of each Gaussian: the keyframe that it was inserted from (when a closed loop moves a keyframe, its Gaussians
//! go with it), its age, and what it was ever worth.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::KeyframeId;
use crate::geometry::{Se3, Sim3};
use crate::optimise::GaussianScore;
use crate::render::{Plan, RunMotion};

/// A keyframe that has moved by less than each of these since its Gaussians did was only refined, and optimisation takes these along; a loop moves it
/// further.
const MIN_SHIFT_METRES: f64 = 0.01;
const MIN_TURN_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// As far as [`MIN_SHIFT_METRES`] at the two metres of a room.
const MIN_LOG_SCALE: f64 = 0.005;

/// Statistics of one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct GaussianHistory {
    /// It moves with this keyframe.
    pub anchor: KeyframeId,
    /// Keyframes, or rounds of a refinement, since it came.
    pub age: u32,
    /// Scored views that blended it, ever.
    pub views: u32,
    /// The most that it added to a pixel of these, 0 to 1.
    pub best_weight: f32,
    /// The most that it added to one view, pixels.
    pub contribution: f32,
}

/// The histories, `[N]` in map order. Inserted Gaussians are appended and pruning keeps the order, so most of a keyframe's Gaussians lie side by side.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct GaussianStats {
    histories: Vec<GaussianHistory>,
}

impl GaussianStats {
    /// The newest `count` Gaussians are of `keyframe`.
    pub fn append(&mut self, keyframe: KeyframeId, count: usize) {
        self.histories.extend(std::iter::repeat_n(GaussianHistory { anchor: keyframe, ..GaussianHistory::default() }, count));
    }

    /// Follows a plan: children inherit the keyframe of their parent, and nothing else.
    pub fn apply(&mut self, plan: &Plan) {
        let child =
            |parent: u32| GaussianHistory { anchor: self.histories[parent as usize].anchor, ..GaussianHistory::default() };
        let kept = plan.keep.iter().map(|i| self.histories[*i as usize]);
        self.histories = kept.chain(plan.parents().map(child)).collect();
    }

    /// Another keyframe was mapped.
    pub fn keyframe_mapped(&mut self) {
        self.histories.iter_mut().for_each(|history| history.age += 1);
    }

    /// Views were scored.
    pub fn scored(&mut self, scores: &[GaussianScore]) {
        for (history, score) in self.histories.iter_mut().zip(scores) {
            history.views += score.views as u32;
            history.best_weight = history.best_weight.max(score.weight_max);
            history.contribution = history.contribution.max(score.weight_sum / score.views.max(1.0));
        }
    }

    pub fn histories(&self) -> &[GaussianHistory] {
        &self.histories
    }

    /// The runs of Gaussians whose keyframe is among `motions`, ascending.
    pub fn moved(&self, motions: &BTreeMap<KeyframeId, Sim3>) -> Vec<RunMotion> {
        let mut runs = Vec::new();
        let mut first = 0;
        for run in self.histories.chunk_by(|a, b| a.anchor == b.anchor) {
            if let Some(new_from_old) = motions.get(&run[0].anchor) {
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
    let far = old_from_new.translation.vector.norm() > MIN_SHIFT_METRES
        || old_from_new.rotation.angle() > MIN_TURN_RAD
        || scale.ln().abs() > MIN_LOG_SCALE;
    let world_from_old_camera = Sim3 { scale, ..Sim3::from(*new_world_from_camera) };
    far.then(|| world_from_old_camera * Sim3::from(*old_world_from_camera).inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Child;
    use glam::Vec3;
    use nalgebra::{Point3, Vector3};

    #[test]
    fn runs_follow_appending_pruning_and_growing() {
        let mut stats = GaussianStats::default();
        [(0, 4), (2, 3), (5, 2)].into_iter().for_each(|(keyframe, count)| stats.append(keyframe, count));
        let child = |parent| Child { parent, mean: Vec3::ZERO, raw_opacity: 0.0, log_scale: Vec3::ZERO };
        stats.apply(&Plan { keep: vec![0, 3, 4, 6, 8], children: [1, 5, 5].map(child).to_vec() });
        let new_from_old = Sim3::from(Se3::translation(1.0, 0.0, 0.0));
        let motions = [2, 5, 7].map(|keyframe| (keyframe, new_from_old)).into();
        assert_eq!(stats.moved(&motions), [2..4, 4..5, 6..8].map(|run| RunMotion { run, new_from_old }));
        assert!(stats.moved(&BTreeMap::new()).is_empty());
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
    fn a_history_keeps_age_views_and_the_best_of_them() {
        let mut stats = GaussianStats::default();
        stats.append(3, 2);
        let score =
            |views: f32, weight_max: f32, weight_sum: f32| GaussianScore { views, weight_max, weight_sum, ..Default::default() };
        stats.keyframe_mapped();
        stats.scored(&[score(4.0, 0.5, 6.0), score(0.0, 0.0, 0.0)]);
        stats.keyframe_mapped();
        stats.scored(&[score(2.0, 0.25, 5.0), score(1.0, 0.125, 0.5)]);
        let history = |views, best_weight, contribution| GaussianHistory { anchor: 3, age: 2, views, best_weight, contribution };
        assert_eq!(stats.histories(), [history(6, 0.5, 2.5), history(1, 0.125, 0.5)]);
    }

    #[test]
    fn a_shift_counts_only_beyond_its_threshold() {
        let shifted = |metres: f64| motion(&Se3::identity(), &Se3::translation(metres, 0.0, 0.0), 1.0);
        assert_eq!(shifted(MIN_SHIFT_METRES), None);
        assert_eq!(shifted(2.0 * MIN_SHIFT_METRES), Some(Se3::translation(2.0 * MIN_SHIFT_METRES, 0.0, 0.0).into()));
    }
}
