//! Keyframe poses refined by the images: each training step's gradient by the pose moves its keyframe by a step of Adam (as MonoGS does,
//! Matsuki et al., *Gaussian Splatting SLAM*, CVPR 2024), bounded, and relative to where the tracker has it.
//!
//! The second moment is that of a whole vector's length, one for translation and one for rotation: a step then points along the averaged
//! gradient whatever the axes, and weak directions are not blown up to the size of strong ones.

use nalgebra::Vector6;
use serde::{Deserialize, Serialize};

use super::KeyframeId;
use crate::geometry::{Se3, se3};

/// Decay of the first and the second moments.
const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.99;
/// Below any gradient that means something.
const EPSILON: f64 = 1e-12;
/// A keyframe that took fewer steps is still where the tracker put it, and to say so would only repeat the tracker to itself.
const MIN_STEPS: i32 = 8;

/// Whether and how far keyframe poses follow the images.
///
/// Off: in the few steps that a live map gets, refined poses come out only little truer than the tracker's from one keyframe to the next
/// (1.64 against 1.81 mm, 0.55 against 0.65 mrad, on a room with noise and blur, mapped at a quarter of its size), and drift as a whole.
/// Held-out images gain what working on all tiles gives them, and no more.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefinePosesConfig {
    /// Whether poses are refined at all.
    pub enabled: bool,
    /// Whether refined poses are sent to the tracker, as relative pose measurements.
    pub tell_tracker: bool,
    /// Most that a step turns or shifts a keyframe: radians, metres.
    pub lr_rotation: f64,
    /// Most that a step shifts a keyframe, metres.
    pub lr_translation: f64,
    /// Share of the way back to the tracker's pose that each step begins with: keeps the window from drifting off as a whole.
    pub pull: f64,
    /// A step that would lead further than this from the tracker's pose is not taken: radians, metres.
    pub max_turn_rad: f64,
    /// Largest distance from the tracker's pose, metres.
    pub max_shift_metres: f64,
    /// Standard deviation of a refined relative pose, in pixels of the mapped image at the keyframe's median depth. On a synthetic room
    /// the refined poses are truer than that, by 0.07 pixels, but most of this is the tracker's own say coming back: at 0.1 it holds the
    /// tracker from bettering itself (ATE +9%). On RedKitchen, whose 600 frames give small biases time to add up, 0.5 raises the ATE by 8
    /// to 11%, 1 by 0 to 8%, and 2 leaves it (0.552 cm in three runs, as without) with steps from frame to frame as true or up to 11% truer.
    pub sigma_pixels: f64,
}

impl Default for RefinePosesConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            tell_tracker: true,
            lr_rotation: 1e-4,
            lr_translation: 2e-4,
            pull: 0.05,
            max_turn_rad: 0.01,
            max_shift_metres: 0.02,
            sigma_pixels: 2.0,
        }
    }
}

impl RefinePosesConfig {
    /// Checks every value.
    pub(super) fn validate(&self) -> Result<(), String> {
        let values = [
            ("lr_rotation", self.lr_rotation),
            ("lr_translation", self.lr_translation),
            ("pull", self.pull),
            ("max_turn_rad", self.max_turn_rad),
            ("max_shift_metres", self.max_shift_metres),
        ];
        if let Some((name, value)) = values.iter().find(|(_, value)| !(0.0..=1.0).contains(value)) {
            return Err(format!("{name} must lie between 0 and 1, not {value}"));
        }
        if self.sigma_pixels.is_finite() && self.sigma_pixels > 0.0 {
            Ok(())
        } else {
            Err("sigma_pixels must be positive".into())
        }
    }
}

/// How one keyframe's pose differs from the tracker's, and Adam's moments.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct PoseRefinement {
    /// camera_from_world = refined_from_tracked · tracked_from_world
    pub refined_from_tracked: Se3,
    /// Mean of the gradient by (ρ, θ), and of its squared lengths.
    mean: Vector6<f64>,
    mean_squares: [f64; 2],
    steps: i32,
}

impl Default for PoseRefinement {
    fn default() -> Self {
        Self { refined_from_tracked: Se3::identity(), mean: Vector6::zeros(), mean_squares: [0.0; 2], steps: 0 }
    }
}

impl PoseRefinement {
    /// Whether enough steps were taken for the pose to differ from the tracker's by what the images say.
    pub fn is_informative(&self) -> bool {
        self.steps >= MIN_STEPS
    }

    /// One step down a loss's `gradient` by τ = (ρ, θ) of `camera_from_world ← Exp(τ)·camera_from_world`, taken where the refined pose
    /// is; `lr_scale` is a share of the rates. A gradient that is not finite says nothing.
    pub fn step(&mut self, gradient: &[f32; 6], lr_scale: f32, config: &RefinePosesConfig) {
        let gradient = Vector6::from(gradient.map(f64::from));
        if !gradient.iter().all(|g| g.is_finite()) {
            return;
        }
        self.steps += 1;
        self.mean = self.mean * BETA_1 + gradient * (1.0 - BETA_1);
        let [unbiased_1, unbiased_2] = [BETA_1, BETA_2].map(|beta| 1.0 - beta.powi(self.steps));
        let mut tau = -self.mean / unbiased_1;
        for (k, rate) in [config.lr_translation, config.lr_rotation].into_iter().enumerate() {
            let squared = gradient.fixed_rows::<3>(3 * k).norm_squared();
            let mean_square = &mut self.mean_squares[k];
            *mean_square = *mean_square * BETA_2 + squared * (1.0 - BETA_2);
            let length = (*mean_square / unbiased_2).sqrt();
            tau.fixed_rows_mut::<3>(3 * k).scale_mut(rate * f64::from(lr_scale) / (length + EPSILON));
        }
        let kept = se3::log(&self.refined_from_tracked) * (1.0 - config.pull);
        let mut refined = se3::exp(&tau) * se3::exp(&kept);
        refined.rotation.renormalize();
        // NaN is within no bound.
        if refined.translation.vector.norm() <= config.max_shift_metres && refined.rotation.angle() <= config.max_turn_rad {
            self.refined_from_tracked = refined;
        }
    }
}

/// Relative pose of two keyframes, refined by their images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RefinedPair {
    /// The keyframe that is measured.
    pub keyframe: KeyframeId,
    /// The keyframe that it is measured against.
    pub relative_to: KeyframeId,
    /// Relative pose of the two cameras.
    pub keyframe_from_relative: Se3,
    /// Standard deviations of each coordinate of the translation, in the keyframe's frame, and of the rotation about each axis.
    pub sigma_translation_metres: f64,
    /// Standard deviation of the rotation about each axis, radians.
    pub sigma_rotation_rad: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Squared errors of points that a camera sees: the least is where the camera is.
    fn gradient(refined: &Se3, truth: &Se3) -> [f32; 6] {
        let points = (0..40).map(|i| Vector3::new(f64::from(i % 8) - 3.5, f64::from(i / 8) - 2.0, 4.0 + f64::from(i % 3)) * 0.4);
        let sum = points.fold(Vector6::zeros(), |sum, p| {
            let (p, wanted) = (refined * nalgebra::Point3::from(p), truth * nalgebra::Point3::from(p));
            let error = p - wanted;
            let by_theta = p.coords.cross(&error);
            sum + Vector6::new(error.x, error.y, error.z, by_theta.x, by_theta.y, by_theta.z)
        });
        std::array::from_fn(|k| sum[k] as f32)
    }

    #[test]
    fn steps_lead_to_the_least_loss_and_not_beyond_the_bounds() {
        let config = RefinePosesConfig { enabled: true, pull: 0.0, ..Default::default() };
        let truth = se3::exp(&Vector6::new(0.004, -0.003, 0.002, 0.003, -0.002, 0.001));
        let mut refinement = PoseRefinement::default();
        let distance = |r: &PoseRefinement| se3::log(&(r.refined_from_tracked * truth.inverse())).norm();
        let before = distance(&refinement);
        for step in 0..800 {
            refinement.step(&gradient(&refinement.refined_from_tracked, &truth), 1.0 - step as f32 / 800.0, &config);
        }
        assert!(distance(&refinement) < 0.05 * before, "{} of {before}", distance(&refinement));
        let far = se3::exp(&Vector6::new(1.0, 0.0, 0.0, 0.0, 0.2, 0.0));
        for _ in 0..1000 {
            refinement.step(&gradient(&refinement.refined_from_tracked, &far), 1.0, &config);
        }
        let refined = refinement.refined_from_tracked;
        assert!(refined.translation.vector.norm() <= config.max_shift_metres && refined.rotation.angle() <= config.max_turn_rad);
        assert!(
            refined.translation.vector.norm() > 0.9 * config.max_shift_metres
                || refined.rotation.angle() > 0.9 * config.max_turn_rad
        );
    }

    #[test]
    fn nonsense_moves_nothing() {
        let config = RefinePosesConfig { enabled: true, ..Default::default() };
        let mut refinement = PoseRefinement::default();
        for gradient in [[f32::NAN; 6], [0.0, f32::INFINITY, 0.0, 0.0, 0.0, 0.0], [0.0; 6]] {
            refinement.step(&gradient, 1.0, &config);
        }
        assert_eq!(refinement.refined_from_tracked, Se3::identity());
        refinement.step(&[f32::MAX; 6], 1.0, &config);
        assert!(se3::log(&refinement.refined_from_tracked).iter().all(|v| v.is_finite()));
    }
}
