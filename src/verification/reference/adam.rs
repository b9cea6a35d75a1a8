//! One Adam step (Kingma & Ba 2015) on a row of numbers; twin of `shaders/shared/sink_adam.wgsl`.

/// Moments, step count and averaged parameters of one Gaussian.
#[derive(Clone, Debug, Default)]
pub struct Adam64 {
    /// First moments, one a parameter.
    pub first: Vec<f64>,
    /// Second moments, one a parameter.
    pub second: Vec<f64>,
    /// Steps with a gradient.
    pub steps: i32,
    /// Exponential moving average of the parameters.
    pub average: Vec<f64>,
}

/// Decay of the moments, and the denominator's offset.
#[derive(Clone, Copy, Debug)]
pub struct Decay64 {
    /// Decay of the first moment.
    pub beta_1: f64,
    /// Decay of the second moment.
    pub beta_2: f64,
    /// Offset of the denominator.
    pub epsilon: f64,
}

impl Adam64 {
    /// Moves `parameters` by `gradient`; a gradient that is zero throughout moves nothing and counts no step.
    pub fn step(&mut self, parameters: &mut [f64], gradient: &[f64], rates: &[f64], decay: Decay64) {
        let Decay64 { beta_1, beta_2, epsilon } = decay;
        if gradient.iter().all(|g| *g == 0.0) {
            return;
        }
        self.first.resize(parameters.len(), 0.0);
        self.second.resize(parameters.len(), 0.0);
        self.steps += 1;
        for i in 0..parameters.len() {
            self.first[i] = beta_1 * self.first[i] + (1.0 - beta_1) * gradient[i];
            self.second[i] = beta_2 * self.second[i] + (1.0 - beta_2) * gradient[i] * gradient[i];
            let m = self.first[i] / (1.0 - beta_1.powi(self.steps));
            let v = self.second[i] / (1.0 - beta_2.powi(self.steps));
            parameters[i] -= rates[i] * m / (v.sqrt() + epsilon);
        }
    }

    /// Takes the parameters into their average, after a step that moved them.
    pub fn take_average(&mut self, parameters: &[f64], least_share: f64) {
        self.average.resize(parameters.len(), 0.0);
        let share = least_share.max(1.0 / (1.0 + f64::from(self.steps - 1) / 4.0));
        self.average.iter_mut().zip(parameters).for_each(|(average, now)| *average += share * (now - *average));
    }
}
