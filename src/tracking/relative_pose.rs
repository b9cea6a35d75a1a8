//! What someone else measured of two keyframes' relative pose, with its noise: kept with the map, newest per pair, and used beside the
//! landmarks by bundle adjustment and, beside the loops, by the pose graph.
//!
//! A measurement may improve a pose and never tear the map: errors far beyond its noise pull less and less (Huber), and what contradicts
//! the landmarks altogether is left out.

use std::f64::consts::PI;

use super::TrackingError;
use super::map::Map;
use super::pose_graph::Edge;
use crate::geometry::sim3::Vector7;
use crate::geometry::{Se3, Sim3};

/// What a standard deviation may be, metres and radians: less is nobody's accuracy and would make the equations stiff.
const MIN_SIGMA: f64 = 1e-5;
const MAX_SIGMA_METRES: f64 = 10.0;
const MAX_METRES: f64 = 1e4;
/// Errors beyond this many standard deviations pull less and less.
const DOUBT: f64 = 3.0;
/// Errors that are still beyond this many where the landmarks have settled are not believed.
const BELIEF: f64 = 6.0;

/// A measured pose of one keyframe in the frame of another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseMeasurement {
    pub keyframe: usize,
    pub relative_to: usize,
    pub keyframe_from_relative: Se3,
    /// Standard deviation of each coordinate of the translation, in the keyframe's frame.
    pub sigma_translation_metres: f64,
    /// Standard deviation of the rotation about each axis.
    pub sigma_rotation_rad: f64,
}

impl PoseMeasurement {
    /// # Errors
    /// [`TrackingError::Measurement`] if a number is not finite or out of range, or a keyframe unknown.
    pub(super) fn check(&self, keyframes: usize) -> Result<(), TrackingError> {
        let Self { keyframe, relative_to, .. } = *self;
        let pose = &self.keyframe_from_relative;
        let metres = pose.translation.vector.norm();
        let turned = pose.rotation.coords.norm();
        // NaN is in no range.
        let problem = if keyframe == relative_to || keyframe.max(relative_to) >= keyframes {
            format!("it must be of two of the {keyframes} keyframes")
        } else if !(0.0..=MAX_METRES).contains(&metres) || !(0.999..=1.001).contains(&turned) {
            "its pose is no rigid motion of at most 10 km".to_owned()
        } else if !(MIN_SIGMA..=MAX_SIGMA_METRES).contains(&self.sigma_translation_metres) {
            format!("sigma_translation_metres must be from {MIN_SIGMA} to {MAX_SIGMA_METRES}")
        } else if !(MIN_SIGMA..=PI).contains(&self.sigma_rotation_rad) {
            format!("sigma_rotation_rad must be from {MIN_SIGMA} to π")
        } else {
            return Ok(());
        };
        Err(TrackingError::Measurement { keyframe, relative_to, problem })
    }

    /// The factor between the poses `a`, of the keyframe, and `b`. It knows nothing of scales.
    pub(super) fn edge(&self, a: usize, b: usize) -> Edge {
        let (t, r) = (1.0 / self.sigma_translation_metres, 1.0 / self.sigma_rotation_rad);
        let weights = Vector7::from_column_slice(&[t, t, t, r, r, r, 0.0]);
        Edge { a, b, a_from_b: Sim3::from(self.keyframe_from_relative), weights, doubt: Some(DOUBT) }
    }

    fn pair(&self) -> (usize, usize) {
        (self.keyframe.min(self.relative_to), self.keyframe.max(self.relative_to))
    }

    /// The same, said of the keyframes that hold those that were culled; `None` if that is one and the same.
    fn of_living(mut self, map: &Map) -> Option<Self> {
        if let Some(held) = map.culled.get(&self.keyframe) {
            self.keyframe = held.by;
            self.keyframe_from_relative = held.camera_from_holder.inverse() * self.keyframe_from_relative;
        }
        if let Some(held) = map.culled.get(&self.relative_to) {
            self.relative_to = held.by;
            self.keyframe_from_relative *= held.camera_from_holder;
        }
        (self.keyframe != self.relative_to).then_some(self)
    }
}

/// Whether the factor agrees with poses that have settled.
pub fn is_believed(factor: &Edge, a_from_world: &Se3, b_from_world: &Se3) -> bool {
    factor.residual(&Sim3::from(*a_from_world), &Sim3::from(*b_from_world)).norm() <= BELIEF
}

/// Keeps a measurement; it takes the place of an earlier one of the same pair.
pub fn keep(map: &mut Map, measurement: PoseMeasurement) {
    if let Some(measurement) = measurement.of_living(map) {
        map.measured.insert(measurement.pair(), measurement);
    }
}

/// What was measured of a keyframe that has been culled is from now on said of its holder, unless that has its own.
pub fn pass_on(map: &mut Map, culled: usize) {
    let concerned: Vec<(usize, usize)> = map.measured.keys().filter(|(a, b)| *a == culled || *b == culled).copied().collect();
    for pair in concerned {
        if let Some(measurement) = map.measured.remove(&pair).and_then(|m| m.of_living(map)) {
            map.measured.entry(measurement.pair()).or_insert(measurement);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::frame_features::FrameFeatures;
    use super::super::map::{Held, Keyframe};
    use super::*;
    use crate::geometry::se3;
    use nalgebra::{UnitQuaternion, Vector6};

    /// Four keyframes, and the true relative pose of two of them.
    fn map() -> Map {
        let keyframe = |k: usize| Keyframe {
            frame_index: k,
            timestamp_s: k as f64,
            camera_from_world: se3::exp(&(Vector6::new(0.3, -0.1, 0.2, 0.1, 0.2, -0.1) * k as f64)),
            features: Arc::new(FrameFeatures::default()),
            landmarks: Vec::new(),
        };
        Map { keyframes: (0..4).map(keyframe).collect(), ..Default::default() }
    }

    fn measured(map: &Map, keyframe: usize, relative_to: usize) -> PoseMeasurement {
        let pose = |k: usize| map.keyframes[k].camera_from_world;
        let keyframe_from_relative = pose(keyframe) * pose(relative_to).inverse();
        PoseMeasurement {
            keyframe,
            relative_to,
            keyframe_from_relative,
            sigma_translation_metres: 0.01,
            sigma_rotation_rad: 0.01,
        }
    }

    #[test]
    fn nonsense_is_refused_in_words() {
        let good = measured(&map(), 1, 2);
        good.check(4).unwrap();
        let broken = Se3::from_parts(
            good.keyframe_from_relative.translation,
            UnitQuaternion::new_unchecked(f64::NAN * *good.keyframe_from_relative.rotation.quaternion()),
        );
        for (bad, word) in [
            (PoseMeasurement { relative_to: 1, ..good }, "two of the 4"),
            (PoseMeasurement { keyframe: 4, ..good }, "two of the 4"),
            (PoseMeasurement { sigma_translation_metres: f64::NAN, ..good }, "sigma_translation_metres"),
            (PoseMeasurement { sigma_translation_metres: 0.0, ..good }, "sigma_translation_metres"),
            (PoseMeasurement { sigma_rotation_rad: f64::INFINITY, ..good }, "sigma_rotation_rad"),
            (PoseMeasurement { keyframe_from_relative: Se3::translation(f64::NAN, 0.0, 0.0), ..good }, "rigid motion"),
            (PoseMeasurement { keyframe_from_relative: Se3::translation(1e9, 0.0, 0.0), ..good }, "rigid motion"),
            (PoseMeasurement { keyframe_from_relative: broken, ..good }, "rigid motion"),
        ] {
            let said = bad.check(4).unwrap_err().to_string();
            assert!(said.contains(word), "{said}");
        }
    }

    #[test]
    fn the_newest_of_a_pair_is_kept_and_passed_on_when_a_keyframe_is_culled() {
        let mut map = map();
        let stale = PoseMeasurement { keyframe_from_relative: Se3::identity(), ..measured(&map, 2, 1) };
        let all = [stale, measured(&map, 1, 2), measured(&map, 3, 2), measured(&map, 3, 1)];
        all.iter().for_each(|m| keep(&mut map, *m));
        assert_eq!(map.measured.keys().copied().collect::<Vec<_>>(), [(1, 2), (1, 3), (2, 3)]);
        assert_eq!(map.measured[&(1, 2)], all[1]);
        let camera_from_holder = map.keyframes[1].camera_from_world * map.keyframes[0].camera_from_world.inverse();
        map.culled.insert(1, Held { by: 0, camera_from_holder });
        pass_on(&mut map, 1);
        let of_one_and_the_same = measured(&map, 1, 0);
        keep(&mut map, of_one_and_the_same);
        assert_eq!(map.measured.keys().copied().collect::<Vec<_>>(), [(0, 2), (0, 3), (2, 3)]);
        for m in map.measured.values() {
            let truth = measured(&map, m.keyframe, m.relative_to).keyframe_from_relative;
            assert!(se3::log(&(m.keyframe_from_relative * truth.inverse())).norm() < 1e-12);
        }
    }
}
