//! What a tracked frame saw, by which its pose is solved again.

use nalgebra::Vector2;

use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::map::sparse_map::Map;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose::{PoseObservation, PosePrior};
use crate::tracking::solvers::relative_pose::RelativePose;
use crate::tracking::solvers::residual::Measurement;

/// Landmarks that a frame saw.
#[derive(Clone, Debug, Default)]
pub(super) struct Sightings {
    pub seen: Vec<Sighting>,
    /// How many keyframes there were: later landmarks may have taken the places of these.
    known: usize,
    /// The frame's pose relative to a keyframe by all pixels, where landmarks were few.
    relative_pose: Option<Box<RelativePose>>,
}

/// A landmark where a frame saw it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sighting {
    landmark: u32,
    pixel: [f32; 2],
    /// 1/metres; NaN without depth.
    inverse_depth: f32,
    /// Inverse standard deviations of pixel and inverse depth.
    weights: [f32; 2],
}

impl Sightings {
    pub fn new(features: &FrameFeatures, landmarks: &[Option<usize>], map: &Map, rig: &Rig) -> Self {
        // No larger than needed: they stay for as long as the recording lasts.
        let mut seen = Vec::with_capacity(landmarks.iter().flatten().count());
        seen.extend(features.features.iter().zip(landmarks).filter_map(|(feature, landmark)| {
            let measured = rig.biased_measurement(feature);
            Some(Sighting {
                landmark: u32::try_from((*landmark)?).ok()?,
                pixel: [measured.pixel.x as f32, measured.pixel.y as f32],
                inverse_depth: measured.inverse_depth.map_or(f32::NAN, |inverse| inverse as f32),
                weights: [measured.pixel_weight as f32, measured.depth_weight as f32],
            })
        }));
        Self { seen, known: map.keyframes.len(), relative_pose: None }
    }

    pub fn with_relative_pose(self, relative_pose: Option<RelativePose>) -> Self {
        Self { relative_pose: relative_pose.map(Box::new), ..self }
    }

    pub fn bytes(&self) -> usize {
        self.seen.len() * size_of::<Sighting>() + self.relative_pose.as_deref().map_or(0, size_of_val)
    }

    /// Landmarks that are still there, and where they were measured.
    pub fn measured(&self, map: &Map) -> Vec<(usize, Measurement)> {
        let measured = |s: &Sighting| {
            let landmark = map.resolve_since(s.landmark as usize, self.known)?;
            let measurement = Measurement {
                pixel: Vector2::from(s.pixel.map(f64::from)),
                inverse_depth: (!s.inverse_depth.is_nan()).then_some(s.inverse_depth.into()),
                pixel_weight: s.weights[0].into(),
                depth_weight: s.weights[1].into(),
            };
            Some((landmark, measurement))
        };
        self.seen.iter().filter_map(measured).collect()
    }

    /// The relative pose, unless its keyframe was culled.
    pub fn living_relative_pose(&self, map: &Map) -> Option<&RelativePose> {
        self.relative_pose.as_deref().filter(|relative| map.living.contains(&relative.reference))
    }

    /// What it says of the frame's pose.
    pub fn prior(&self, map: &Map) -> Option<PosePrior> {
        let relative = self.living_relative_pose(map)?;
        Some(relative.prior(&map.keyframes[relative.reference].camera_from_world))
    }

    /// The same with their places, freed of the depth's bias.
    pub fn observations(&self, map: &Map, rig: &Rig) -> Vec<PoseObservation> {
        let observation = |(landmark, measured): (usize, Measurement)| {
            let measurement = measured.without_bias(&rig.pinhole, &rig.depth_bias);
            PoseObservation { point_in_world: map.position(landmark), measurement }
        };
        self.measured(map).into_iter().map(observation).collect()
    }
}
