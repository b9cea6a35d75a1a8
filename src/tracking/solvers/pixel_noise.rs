//! Noise of keypoints, as a recording's own residuals show it.
//!
//! The median over a frame's matches knows no outliers and hardly depends on the estimate itself. It only narrows the configured deviation: where
//! residuals are larger, more false matches are a likelier reason than more noise.

/// A landmark's views share errors, which no residual shows: the deviation that counts is so many times that of the residuals.
const COVERED: f64 = 1.43;
/// Median of the squared length of a residual of two coordinates, in variances of one: 2·ln 2.
const MEDIAN_SQUARED: f64 = 2.0 * std::f64::consts::LN_2;
/// The configured deviation counts as that of so many frames, and the past as so many at most.
const PRIOR_FRAMES: f64 = 10.0;
const MOST_FRAMES: f64 = 200.0;
/// The least estimate, as a share of the configured deviation.
const LEAST_SHARE: f64 = 0.5;

/// Running estimate of the standard deviation of a keypoint's coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelNoise {
    configured: f64,
    sigma: f64,
    /// Sum over frames, and how many.
    variance: f64,
    frames: f64,
}

impl PixelNoise {
    /// As configured: pixels at the finest pyramid level.
    pub fn new(configured: f64) -> Self {
        Self { configured, sigma: configured, variance: 0.0, frames: 0.0 }
    }

    /// Standard deviation of each coordinate, pixels at the finest pyramid level.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Takes in a frame: the median of its squared pixel residuals, whitened by [`Self::sigma`].
    pub fn observe(&mut self, median_squared: f64) {
        let keep = (MOST_FRAMES / (self.frames + 1.0)).min(1.0);
        self.variance = keep * (self.variance + median_squared / MEDIAN_SQUARED * (COVERED * self.sigma).powi(2));
        self.frames = keep * (self.frames + 1.0);
        let prior = PRIOR_FRAMES * self.configured * self.configured;
        let sigma = ((self.variance + prior) / (self.frames + PRIOR_FRAMES)).sqrt();
        self.sigma = sigma.clamp(LEAST_SHARE * self.configured, self.configured);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// After `frames` frames whose coordinates deviate by `deviation` pixels.
    fn after(frames: usize, deviation: f64, mut noise: PixelNoise) -> PixelNoise {
        for _ in 0..frames {
            noise.observe(MEDIAN_SQUARED * (deviation / noise.sigma()).powi(2));
        }
        noise
    }

    #[test]
    fn it_follows_the_residuals_within_its_bounds() {
        let noise = PixelNoise::new(1.0);
        assert_eq!(noise.sigma(), 1.0);
        let found = after(150, 0.5, noise).sigma();
        assert!((found - 0.5 * COVERED).abs() < 0.03, "{found}");
        assert_eq!(after(300, 0.1, noise).sigma(), LEAST_SHARE);
        assert_eq!(after(300, 3.0, noise).sigma(), 1.0);
        // What changes is followed, slowly.
        let limit = ((MOST_FRAMES * (0.5 * COVERED).powi(2) + PRIOR_FRAMES) / (MOST_FRAMES + PRIOR_FRAMES)).sqrt();
        let changed = after(600, 0.5, after(2000, 0.6, noise)).sigma();
        assert!((changed - limit).abs() < 0.01, "{changed} {limit}");
        // The unit of the configuration does not matter.
        assert!((after(150, 1.0, PixelNoise::new(2.0)).sigma() - 2.0 * found).abs() < 1e-9);
    }
}
