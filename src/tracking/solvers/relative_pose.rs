//! Measured relative poses of two keyframes, with their noise: robust factors of bundle adjustment and of the pose graph.
//!
//! A measurement may improve a pose and never tear the map: errors far beyond its noise are down-weighted (Huber), and measurements that
//! contradict the landmarks are rejected.

use std::f64::consts::PI;

use crate::geometry::sim3::Vector7;
use crate::geometry::{Se3, Sim3};
use crate::tracking::TrackingError;
use crate::tracking::solvers::pose_graph::Edge;

/// Range of standard deviations, metres and radians: smaller ones would make the equations stiff.
const MIN_SIGMA: f64 = 1e-5;
const MAX_SIGMA_METRES: f64 = 10.0;
const MAX_METRES: f64 = 1e4;
/// Errors beyond this many standard deviations pull less and less.
const HUBER_SIGMAS: f64 = 3.0;
/// Gate: factors with a larger error after the landmarks converged are rejected.
const GATE_SIGMAS: f64 = 6.0;

/// A measured pose of one keyframe in the frame of another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseMeasurement {
    /// The measured keyframe.
    pub keyframe: usize,
    /// The reference keyframe.
    pub relative_to: usize,
    /// The measured pose, metres.
    pub keyframe_from_relative: Se3,
    /// Standard deviation of each coordinate of the translation, in the keyframe's frame.
    pub sigma_translation_metres: f64,
    /// Standard deviation of the rotation about each axis.
    pub sigma_rotation_rad: f64,
}

impl PoseMeasurement {
    /// # Errors
    /// [`TrackingError::Measurement`] if a number is not finite or out of range, or a keyframe unknown.
    pub(crate) fn check(&self, keyframes: usize) -> Result<(), TrackingError> {
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
    pub(crate) fn edge(&self, a: usize, b: usize) -> Edge {
        let (t, r) = (1.0 / self.sigma_translation_metres, 1.0 / self.sigma_rotation_rad);
        let weights = Vector7::from_column_slice(&[t, t, t, r, r, r, 0.0]);
        Edge { a, b, a_from_b: Sim3::from(self.keyframe_from_relative), weights, huber: Some(HUBER_SIGMAS) }
    }

    /// Both keyframes, the lower id first.
    pub fn pair(&self) -> (usize, usize) {
        (self.keyframe.min(self.relative_to), self.keyframe.max(self.relative_to))
    }
}

/// Whether the factor agrees with poses that have settled.
pub fn passes_gate(factor: &Edge, a_from_world: &Se3, b_from_world: &Se3) -> bool {
    factor.residual(&Sim3::from(*a_from_world), &Sim3::from(*b_from_world)).norm() <= GATE_SIGMAS
}
