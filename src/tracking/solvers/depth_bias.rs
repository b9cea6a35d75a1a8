//! The systematic error of measured depth, which bundle adjustment finds beside poses and points.
//!
//! Rectification leaves the rows of a pair shifted by some hundredths of a pixel: disparities have an offset, which makes what is far too far, and
//! the trajectory too long.
//!
//! Structured light measures disparity. Errors of its calibration, and of its registration with the colour camera, are therefore smooth over the
//! image in inverse depth (Herrera C. et al., *Joint depth and color camera calibration with distortion correction*, 2012).

use nalgebra::{Vector2, Vector3};

use crate::geometry::Pinhole;

/// How far a coefficient moves from one adjustment to the next, in standard deviations of a measurement: the offset, and the tilts.
///
/// The offset is held near zero. It hardly differs from a change of scale, and the scale would drift with it.
const STEP: Vector3<f64> = Vector3::new(0.0004, 0.04, 0.04);
/// How large it is in all, likewise.
const SIZE: Vector3<f64> = Vector3::new(0.004, 0.4, 0.4);

/// Standard deviation of the offset of disparities, pixels.
const PAIR_OFFSET_PIXELS: f64 = 0.07;
/// That of their tilts, as a share of it: none are sought.
const PAIR_TILT: f64 = 1e-3;

/// Measured inverse depth minus the true one, 1/metres: a plane over the image. Offset, tilt along x, tilt along y, each for half the image's
/// width.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthBias(pub Vector3<f64>);

impl DepthBias {
    /// What the coefficients are multiplied by at a pixel.
    pub fn terms(pinhole: &Pinhole, pixel: &Vector2<f64>) -> Vector3<f64> {
        let half = 0.5 * f64::from(pinhole.width);
        Vector3::new(1.0, (pixel.x - pinhole.cx) / half, (pixel.y - pinhole.cy) / half)
    }

    /// The bias at a pixel, 1/metres.
    pub fn at(&self, pinhole: &Pinhole, pixel: &Vector2<f64>) -> f64 {
        self.0.dot(&Self::terms(pinhole, pixel))
    }
}

/// A Gaussian over the coefficients.
#[derive(Clone, Copy, Debug)]
pub struct BiasPrior {
    pub mean: DepthBias,
    /// 1/variance of each coefficient, metres².
    pub information: Vector3<f64>,
}

impl BiasPrior {
    /// For an adjustment after one that found `last`; `sigma` is the standard deviation of a measured inverse depth, 1/metres.
    ///
    /// Each keyframe's depth has errors of its own, so that no window decides alone. The coefficients are drawn to zero.
    pub fn after(last: &DepthBias, sigma: f64) -> Self {
        let near = (STEP * sigma).map(|s| s.powi(-2));
        let small = (SIZE * sigma).map(|s| s.powi(-2));
        let information = near + small;
        Self { mean: DepthBias(last.0.component_mul(&near).component_div(&information)), information }
    }

    /// For a rectified pair; `scale` is depth times disparity, metres times pixels.
    ///
    /// Each adjustment starts from zero. What the lens model leaves out looks like an offset, too, and would add up.
    pub fn of_pair(scale: f64) -> Self {
        let offset = PAIR_OFFSET_PIXELS / scale;
        let deviations = Vector3::new(offset, PAIR_TILT * offset, PAIR_TILT * offset);
        Self { mean: DepthBias::default(), information: deviations.map(|s| s.powi(-2)) }
    }

    /// Half of the cost's gradient, and the cost.
    pub fn pull(&self, bias: &DepthBias) -> (Vector3<f64>, f64) {
        let error = bias.0 - self.mean.0;
        let gradient = error.component_mul(&self.information);
        (gradient, gradient.dot(&error))
    }
}
