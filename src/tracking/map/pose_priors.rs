//! Measured relative poses of keyframes, kept with the map: the newest of each pair. Bundle adjustment and the pose graph use them as robust
//! factors.

use crate::tracking::map::sparse_map::Map;
use crate::tracking::solvers::relative_pose::PoseMeasurement;

impl Map {
    /// Stores a measurement; it replaces an earlier one of the same pair.
    pub fn add_pose_prior(&mut self, measurement: PoseMeasurement) {
        if let Some(measurement) = self.between_living(measurement) {
            self.measured.insert(measurement.pair(), measurement);
        }
    }

    /// Moves the measurements of a culled keyframe to its parent, unless that has its own.
    pub fn move_pose_priors(&mut self, culled: usize) {
        let concerned: Vec<(usize, usize)> =
            self.measured.keys().filter(|(a, b)| *a == culled || *b == culled).copied().collect();
        for pair in concerned {
            if let Some(measurement) = self.measured.remove(&pair).and_then(|m| self.between_living(m)) {
                self.measured.entry(measurement.pair()).or_insert(measurement);
            }
        }
    }

    /// The measurement between the parents of culled keyframes; `None` if both are the same.
    fn between_living(&self, mut measurement: PoseMeasurement) -> Option<PoseMeasurement> {
        if let Some(held) = self.culled.get(&measurement.keyframe) {
            measurement.keyframe = held.parent;
            measurement.keyframe_from_relative = held.camera_from_parent.inverse() * measurement.keyframe_from_relative;
        }
        if let Some(held) = self.culled.get(&measurement.relative_to) {
            measurement.relative_to = held.parent;
            measurement.keyframe_from_relative *= held.camera_from_parent;
        }
        (measurement.keyframe != measurement.relative_to).then_some(measurement)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::geometry::{Se3, se3};
    use crate::tracking::features::frame_features::FrameFeatures;
    use crate::tracking::map::sparse_map::{CulledKeyframe, Keyframe};
    use crate::tracking::solvers::relative_pose::PoseMeasurement;
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
        all.iter().for_each(|m| map.add_pose_prior(*m));
        assert_eq!(map.measured.keys().copied().collect::<Vec<_>>(), [(1, 2), (1, 3), (2, 3)]);
        assert_eq!(map.measured[&(1, 2)], all[1]);
        let camera_from_parent = map.keyframes[1].camera_from_world * map.keyframes[0].camera_from_world.inverse();
        map.culled.insert(1, CulledKeyframe { parent: 0, camera_from_parent });
        map.move_pose_priors(1);
        let of_one_and_the_same = measured(&map, 1, 0);
        map.add_pose_prior(of_one_and_the_same);
        assert_eq!(map.measured.keys().copied().collect::<Vec<_>>(), [(0, 2), (0, 3), (2, 3)]);
        for m in map.measured.values() {
            let truth = measured(&map, m.keyframe, m.relative_to).keyframe_from_relative;
            assert!(se3::log(&(m.keyframe_from_relative * truth.inverse())).norm() < 1e-12);
        }
    }
}
