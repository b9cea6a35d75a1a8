//! The constant-velocity motion model.

use crate::geometry::{Se3, se3};

/// Factor up to which intervals between frames count as the same.
const SAME_INTERVAL: f64 = 1.5;
/// Intervals over which a motion is expected to go on, at most.
const MOST_INTERVALS: f64 = 4.0;

/// How the camera has moved from one frame to the next.
#[derive(Debug)]
pub(super) struct Velocity {
    /// camera_from_last_camera
    pub motion: Se3,
    /// Time between the two, seconds.
    pub interval_s: Option<f64>,
}

impl Velocity {
    /// The motion in so many seconds. Intervals that differ by less than half are taken to be the same: timestamps scatter.
    pub fn motion_in(&self, interval_s: Option<f64>) -> Se3 {
        let ratio = interval_s.zip(self.interval_s).map_or(1.0, |(next_s, last_s)| next_s / last_s);
        if ratio.is_finite() && !(1.0 / SAME_INTERVAL..=SAME_INTERVAL).contains(&ratio) {
            se3::exp(&(se3::log(&self.motion) * ratio.min(MOST_INTERVALS)))
        } else {
            self.motion
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    #[test]
    fn a_motion_goes_on_by_time() {
        let step = Vector6::new(0.1, 0.0, -0.2, 0.0, 0.05, 0.0);
        let velocity = |interval_s| Velocity { motion: se3::exp(&step), interval_s };
        let expected = |last_s, next_s, steps: f64| {
            let difference = velocity(last_s).motion_in(next_s) * se3::exp(&(step * steps)).inverse();
            assert!(se3::log(&difference).norm() < 1e-12, "{last_s:?} {next_s:?}");
        };
        expected(Some(0.1), Some(0.2), 2.0);
        expected(Some(0.2), Some(0.1), 0.5);
        expected(Some(0.1), Some(3.0), MOST_INTERVALS);
        for (last_s, next_s) in [(Some(0.1), Some(0.14)), (None, Some(0.1)), (Some(0.1), None), (Some(0.0), Some(0.1))] {
            expected(last_s, next_s, 1.0);
        }
    }
}
