//! Adam's step sizes, and their form on the GPU.

use serde::{Deserialize, Serialize};

use crate::render::layout::AdamSetup;

/// Step sizes and decay rates (Kingma & Ba 2015), several times those of 3DGS (Kerbl et al. 2023): a map gets tens of steps a keyframe, not
/// tens of thousands. The first moment forgets sooner, since each step sees another view. `docs/lab-notes` has what these are worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamConfig {
    /// Position, in units of the Gaussian's own size (geometric mean of its standard deviations) a step: fine ones move finely, and the
    /// result does not depend on the unit of length.
    pub lr_position: f32,
    /// Raw opacity (logit) a step.
    pub lr_opacity: f32,
    /// Log scale a step.
    pub lr_log_scale: f32,
    /// Quaternion component a step.
    pub lr_rotation: f32,
    /// Constant colour coefficient a step.
    pub lr_color: f32,
    /// Other harmonics' coefficients a step.
    pub lr_harmonics: f32,
    /// Weight of ½ Σ (other harmonics' coefficient)² in the loss summed over the image's pixels: a Gaussian that shows little looks alike from
    /// all sides.
    pub harmonics_prior: f32,
    /// The other harmonics move every n-th step only: they converge slowly, and are most of the parameters (FastGS: 16).
    pub harmonics_every: usize,
    /// Decay of the first and the second moments.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// How many times longer than its second axis a Gaussian's longest may become.
    pub max_elongation: f32,
    /// After n steps of a Gaussian its colours take 1/√(1 + n / this) of their rates: they find their place fast, and then the views'
    /// noise and exposures are averaged. 0: all of them always.
    pub color_settling_steps: f32,
    /// The same for position, opacity, scale and rotation.
    pub geometry_settling_steps: f32,
    /// Both before the final refinement, where new views must not undo what earlier ones taught. 0: the two above.
    pub online_settling_steps: f32,
    /// The map is shown with each Gaussian's parameters averaged over about a quarter of its steps so far, but no more than about so many
    /// of its last ones (Polyak & Juditsky 1992): successive views pull to and fro, and in between is where they agree. The steps
    /// themselves go on from the parameters as they are, and stay quick. 1: the map is shown as it is.
    pub ema_steps: f32,
}

impl Default for AdamConfig {
    fn default() -> Self {
        Self {
            lr_position: 0.12,
            lr_opacity: 0.15,
            lr_log_scale: 0.09,
            lr_rotation: 0.018,
            lr_color: 0.03,
            lr_harmonics: 0.015,
            harmonics_prior: 0.01,
            harmonics_every: 1,
            beta_1: 0.8,
            beta_2: 0.999,
            epsilon: 1e-15,
            max_elongation: 8.0,
            color_settling_steps: 200.0,
            geometry_settling_steps: 0.0,
            online_settling_steps: 100.0,
            ema_steps: 10.0,
        }
    }
}

impl AdamConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        let rates = [self.lr_position, self.lr_opacity, self.lr_log_scale, self.lr_rotation, self.lr_color, self.lr_harmonics];
        if rates.iter().any(|rate| !(rate.is_finite() && *rate >= 0.0)) {
            return Err("every Adam rate must be finite and not negative".into());
        }
        if !(self.harmonics_prior.is_finite() && self.harmonics_prior >= 0.0) {
            return Err("harmonics_prior must be finite and not negative".into());
        }
        if self.harmonics_every == 0 {
            return Err("harmonics_every must be at least 1".into());
        }
        if ![self.beta_1, self.beta_2].iter().all(|beta| (0.0..1.0).contains(beta)) || self.beta_1 == 0.0 || self.beta_2 == 0.0 {
            return Err("beta_1 and beta_2 must lie between 0 and 1, both excluded".into());
        }
        let settling = [self.color_settling_steps, self.geometry_settling_steps, self.online_settling_steps];
        if settling.iter().any(|steps| !(steps.is_finite() && *steps >= 0.0)) {
            return Err(
                "color_settling_steps, geometry_settling_steps and online_settling_steps must be finite and not negative".into(),
            );
        }
        if !(self.ema_steps.is_finite() && self.ema_steps >= 1.0) {
            return Err("ema_steps must be at least 1".into());
        }
        if !(self.max_elongation.is_finite() && self.max_elongation > 1.0) {
            return Err("max_elongation must be greater than 1".into());
        }
        if self.epsilon.is_finite() && self.epsilon > 0.0 { Ok(()) } else { Err("epsilon must be positive".into()) }
    }
}

impl AdamConfig {
    /// The same with the rate of positions multiplied by one factor, and all others by another.
    pub fn scaled(&self, position: f32, others: f32) -> Self {
        Self {
            lr_position: self.lr_position * position,
            lr_opacity: self.lr_opacity * others,
            lr_log_scale: self.lr_log_scale * others,
            lr_rotation: self.lr_rotation * others,
            lr_color: self.lr_color * others,
            lr_harmonics: self.lr_harmonics * others,
            ..self.clone()
        }
    }

    /// The same for steps before the final refinement.
    pub fn online(&self) -> Self {
        match self.online_settling_steps {
            0.0 => self.clone(),
            steps => Self { color_settling_steps: steps, geometry_settling_steps: steps, ..self.clone() },
        }
    }

    /// The GPU's copy for step number `step` of the map. The shortest axis shrinks to the `thickness`, in units of the second; the first `frozen`
    /// Gaussians never move.
    pub(super) fn setup(&self, step: usize, thickness: Option<f32>, frozen: usize) -> AdamSetup {
        let p = self.lr_position;
        let settling = |steps: f32| if steps > 0.0 { steps.recip() } else { 0.0 };
        let rates = [
            [p, p, p, self.lr_opacity],
            // Lanes that hold no parameter stand still.
            [self.lr_log_scale, self.lr_log_scale, self.lr_log_scale, 0.0],
            [self.lr_rotation; 4],
            [self.lr_color, self.lr_color, self.lr_color, 0.0],
            [self.lr_harmonics; 4],
        ];
        AdamSetup {
            rates,
            beta_1: self.beta_1,
            beta_2: self.beta_2,
            epsilon: self.epsilon,
            log_beta_1: self.beta_1.ln(),
            log_beta_2: self.beta_2.ln(),
            step_harmonics: u32::from(step.is_multiple_of(self.harmonics_every)),
            log_elongation: self.max_elongation.ln(),
            log_thickness: thickness.map_or(f32::MAX, f32::ln),
            color_settling: settling(self.color_settling_steps),
            geometry_settling: settling(self.geometry_settling_steps),
            least_share: 1.0 / self.ema_steps,
            frozen: frozen as u32,
            harmonics_prior: self.harmonics_prior,
            pad: [0; 3],
        }
    }
}
