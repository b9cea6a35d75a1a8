//! How a landmark looks from a camera: where it should be seen, how large, and by which descriptor.

use nalgebra::{Matrix3, Vector3};

use crate::geometry::Se3;
use crate::tracking::TrackingConfig;
use crate::tracking::features::descriptor::{Descriptor, representative};
use crate::tracking::features::projection::Projection;
use crate::tracking::map::sparse_map::{Keyframe, LandmarkState, Map};
use crate::tracking::rig::Rig;

/// A landmark is looked for only within 60° of the mean direction from which it was seen.
const MIN_VIEW_COSINE: f64 = 0.5;
/// Slack on the range of distances at which the pyramid can see a landmark.
const RANGE_SLACK: f64 = 1.2;
/// A landmark's descriptor is chosen among those of its latest observations.
const DESCRIPTORS_COMPARED: usize = 10;
/// Landmarks seen together have few anchors: so many are kept by their last digits.
const ANCHORS_KEPT: usize = 64;

impl Map {
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
        let mut anchors = [(usize::MAX, Anchor::default()); ANCHORS_KEPT];
        let predict = |landmark: usize| {
            let id = self.landmarks[landmark].anchor;
            let (kept, anchor) = &mut anchors[id % ANCHORS_KEPT];
            if *kept != id {
                (*kept, *anchor) = (id, Anchor::new(&self.keyframes[id], camera_from_world));
            }
            self.predict(landmark, anchor, rig)
        };
        landmarks.into_iter().filter_map(predict).collect()
    }

    /// Where a camera should see a landmark; `None` outside of its image, its range of distances or its viewing directions.
    fn predict(&self, landmark: usize, anchor: &Anchor, rig: &Rig) -> Option<Projection> {
        let pinhole = &rig.pinhole;
        let l = &self.landmarks[landmark];
        let p_in_camera = anchor.rotation * (l.in_anchor.coords * anchor.unit) + anchor.translation;
        let pixel = pinhole.project(&p_in_camera).filter(|pixel| pinhole.contains(pixel, 0.0))?;
        let distance = p_in_camera.norm();
        let (nearest, furthest) = (l.range.0 * anchor.unit, l.range.1 * anchor.unit);
        if distance < nearest / RANGE_SLACK || distance > furthest * RANGE_SLACK {
            return None;
        }
        let view_cosine = p_in_camera.dot(&(anchor.rotation * l.view_direction)) / distance;
        if view_cosine < MIN_VIEW_COSINE {
            return None;
        }
        Some(Projection {
            point: landmark,
            pixel,
            octave: rig.octave_of_scale(furthest / distance),
            view_cosine,
            inverse_depth: 1.0 / p_in_camera.z,
            descriptor: l.descriptor,
            angle_rad: 0.0,
        })
    }
}

/// camera_from_keyframe of a landmark's anchor, as a matrix.
#[derive(Clone, Copy, Debug, Default)]
struct Anchor {
    rotation: Matrix3<f64>,
    /// Metres.
    translation: Vector3<f64>,
    /// Metres a unit of the keyframe's landmarks.
    unit: f64,
}

impl Anchor {
    fn new(keyframe: &Keyframe, camera_from_world: &Se3) -> Self {
        let camera_from_keyframe = camera_from_world * keyframe.camera_from_world.inverse();
        Self {
            rotation: camera_from_keyframe.rotation.to_rotation_matrix().into_inner(),
            translation: camera_from_keyframe.translation.vector,
            unit: keyframe.unit,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector2};

    use crate::tracking::map::sparse_map::tests::{at, config, map};
    use crate::tracking::solvers::residual::tests::PINHOLE;

    #[test]
    fn a_landmark_is_predicted_where_and_how_large_it_was_seen() {
        let mut map = map();
        let id = map.add_landmark(at(0, 1), Point3::new(0.0, 0.0, 2.0), &config());
        let predict = |pose: &Se3| map.visible([id], pose, &Rig::new(PINHOLE, config())).pop();
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
