//! What a camera measures of a point, its noise, and the derivatives that pose optimisation and bundle adjustment share.
//!
//! A measurement is (u, v, 1/z): pixels of the distortion-free pinhole, and inverse depth where the sensor has one. Inverse depth is
//! what structured light measures (disparity), so its noise is the same at every distance (Khoshelham & Elberink, *Sensors* 2012).
//! Residuals are whitened: prediction minus measurement, in standard deviations.

use nalgebra::{Matrix3, Matrix3x6, Vector2, Vector3};

use crate::geometry::Pinhole;
use crate::geometry::se3::skew;
use crate::tracking::solvers::depth_bias::DepthBias;

/// 95% of true pixels lie below this (χ², 2 degrees of freedom).
pub const CHI2_PIXEL: f64 = 5.991;
/// Squared depth residuals beyond this are wrong: wide, for the tails of a depth sensor are heavy.
const CHI2_DEPTH: f64 = 9.0;
/// Squared depth residuals beyond this pull less and less.
///
/// A single depth varies by a fraction of the standard deviation, which covers errors that a landmark's views share. What varies more is often a surface
/// behind an edge.
pub const HUBER_DEPTH: f64 = 0.04;

/// Points nearer than this to the camera's plane, or behind it, are not seen, metres.
pub const NEAR_METRES: f64 = 1e-2;

/// One measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    pub pixel: Vector2<f64>,
    /// 1/metres.
    pub inverse_depth: Option<f64>,
    /// 1/standard deviation of each pixel coordinate.
    pub pixel_weight: f64,
    /// 1/standard deviation of the inverse depth, metres.
    pub depth_weight: f64,
}

/// Inlier class of a measurement, by the χ² gate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InlierClass {
    /// All that was measured.
    Full,
    /// Its pixel agrees, its depth does not (or there is none): typical at depth edges.
    PixelOnly,
    Outlier,
}

impl Measurement {
    /// Whitened residual at a point in the camera frame; the third entry is 0 without depth. `None` behind the camera.
    pub fn residual(&self, pinhole: &Pinhole, p_in_camera: &Vector3<f64>) -> Option<Vector3<f64>> {
        // NaN is not in front.
        let in_front = p_in_camera.z > NEAR_METRES;
        in_front.then(|| {
            let inverse_z = 1.0 / p_in_camera.z;
            Vector3::new(
                (pinhole.fx * p_in_camera.x * inverse_z + pinhole.cx - self.pixel.x) * self.pixel_weight,
                (pinhole.fy * p_in_camera.y * inverse_z + pinhole.cy - self.pixel.y) * self.pixel_weight,
                self.inverse_depth.map_or(0.0, |measured| (inverse_z - measured) * self.depth_weight),
            )
        })
    }

    /// Derivative of [`Self::residual`] by the point in the camera frame.
    pub fn jacobian(&self, pinhole: &Pinhole, p: &Vector3<f64>) -> Matrix3<f64> {
        let iz = 1.0 / p.z;
        let (fx, fy) = (pinhole.fx * iz * self.pixel_weight, pinhole.fy * iz * self.pixel_weight);
        let depth = if self.inverse_depth.is_some() { -iz * iz * self.depth_weight } else { 0.0 };
        Matrix3::new(fx, 0.0, -fx * p.x * iz, 0.0, fy, -fy * p.y * iz, 0.0, 0.0, depth)
    }

    /// Derivative of [`Self::residual`] by a left perturbation of `camera_from_world`: that by the point times `[I, −skew(p)]`, written out.
    pub fn jacobian_by_pose(&self, pinhole: &Pinhole, p: &Vector3<f64>) -> Matrix3x6<f64> {
        let j = self.jacobian(pinhole, p);
        let (a, b, c, d, e) = (j[(0, 0)], j[(0, 2)], j[(1, 1)], j[(1, 2)], j[(2, 2)]);
        Matrix3x6::from_row_slice(&[
            a,
            0.0,
            b,
            b * p.y,
            a * p.z - b * p.x,
            -a * p.y,
            0.0,
            c,
            d,
            d * p.y - c * p.z,
            -d * p.x,
            c * p.x,
            0.0,
            0.0,
            e,
            e * p.y,
            -e * p.x,
            0.0,
        ])
    }

    /// A copy whose inverse depth is freed of its bias.
    pub fn without_bias(&self, pinhole: &Pinhole, bias: &DepthBias) -> Self {
        Self { inverse_depth: self.inverse_depth.map(|measured| measured - bias.at(pinhole, &self.pixel)), ..*self }
    }

    /// A copy without depth.
    pub fn without_depth(&self) -> Self {
        Self { inverse_depth: None, ..*self }
    }

    /// The measurement restricted to an inlier class; `None` for an outlier.
    pub fn restricted_to(&self, class: InlierClass) -> Option<Self> {
        match class {
            InlierClass::Full => Some(*self),
            InlierClass::PixelOnly => Some(self.without_depth()),
            InlierClass::Outlier => None,
        }
    }

    /// χ² tests at a point in the camera frame; depth may fail alone.
    pub fn classify(&self, pinhole: &Pinhole, p_in_camera: &Vector3<f64>) -> InlierClass {
        let Some(r) = self.residual(pinhole, p_in_camera) else { return InlierClass::Outlier };
        let pixel_agrees = r.x * r.x + r.y * r.y <= CHI2_PIXEL;
        let depth_agrees = self.inverse_depth.is_some() && r.z * r.z <= CHI2_DEPTH;
        match (pixel_agrees, depth_agrees) {
            (false, _) => InlierClass::Outlier,
            (true, true) => InlierClass::Full,
            (true, false) => InlierClass::PixelOnly,
        }
    }

    /// Robust cost of a whitened residual, and the weights that it gives the residual's entries. Pixel and depth have a kernel each,
    /// so that a wrong depth does not cost the pixel its say.
    pub fn robust(residual: &Vector3<f64>) -> (f64, Vector3<f64>) {
        let (pixel_cost, pixel) = huber(residual.x * residual.x + residual.y * residual.y, CHI2_PIXEL);
        let (depth_cost, depth) = huber(residual.z * residual.z, HUBER_DEPTH);
        (pixel_cost + depth_cost, Vector3::new(pixel, pixel, depth))
    }
}

/// Derivative of a point in the camera frame by a left perturbation of `camera_from_world`: `[I, −skew(p)]`.
pub fn point_by_pose(p_in_camera: &Vector3<f64>) -> Matrix3x6<f64> {
    let mut d = Matrix3x6::zeros();
    d.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
    d.fixed_view_mut::<3, 3>(0, 3).copy_from(&-skew(p_in_camera));
    d
}

/// Huber's cost of a squared residual and the weight that it gives the residual: (ρ(s), ρ'(s)), threshold on the square.
pub fn huber(squared: f64, threshold: f64) -> (f64, f64) {
    if squared <= threshold {
        (squared, 1.0)
    } else {
        let ratio = (threshold / squared).sqrt();
        (2.0 * squared * ratio - threshold, ratio)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::geometry::{Se3, se3};
    use nalgebra::{Matrix3x6, Vector6};
    use proptest::prelude::*;

    pub const PINHOLE: Pinhole = Pinhole { fx: 520.0, fy: 515.0, cx: 320.5, cy: 241.0, width: 640, height: 480 };

    proptest! {
        #[test]
        fn jacobians_are_the_numerical_derivatives(
            p in prop::array::uniform3(-1.5f64..1.5), tau in prop::array::uniform6(-0.5f64..0.5), with_depth: bool
        ) {
            let measurement = Measurement {
                pixel: Vector2::new(300.0, 200.0), inverse_depth: with_depth.then_some(0.4), pixel_weight: 0.7, depth_weight: 120.0,
            };
            let camera_from_world = se3::exp(&Vector6::from(tau));
            let p_in_world = camera_from_world.inverse() * nalgebra::Point3::new(p[0], p[1], p[2] + 3.0);
            let at = |pose: &Se3, point: &nalgebra::Point3<f64>| measurement.residual(&PINHOLE, &(pose * point).coords).unwrap();
            let p_in_camera = (camera_from_world * p_in_world).coords;
            let j = measurement.jacobian(&PINHOLE, &p_in_camera);
            let (by_pose, by_point) = (measurement.jacobian_by_pose(&PINHOLE, &p_in_camera), j * camera_from_world.rotation.to_rotation_matrix().matrix());
            const STEP: f64 = 1e-6;
            let mut numeric_pose = Matrix3x6::zeros();
            for k in 0..6 {
                let mut step = Vector6::zeros();
                step[k] = STEP;
                let forward = at(&(se3::exp(&step) * camera_from_world), &p_in_world);
                let backward = at(&(se3::exp(&-step) * camera_from_world), &p_in_world);
                numeric_pose.set_column(k, &((forward - backward) / (2.0 * STEP)));
            }
            prop_assert!((numeric_pose - by_pose).norm() < 1e-6 * (1.0 + by_pose.norm()));
            let mut numeric_point = Matrix3::zeros();
            for k in 0..3 {
                let mut step = Vector3::zeros();
                step[k] = STEP;
                let difference = at(&camera_from_world, &(p_in_world + step)) - at(&camera_from_world, &(p_in_world - step));
                numeric_point.set_column(k, &(difference / (2.0 * STEP)));
            }
            prop_assert!((numeric_point - by_point).norm() < 1e-6 * (1.0 + by_point.norm()));
        }

        #[test]
        fn hubers_weight_is_the_derivative_of_its_cost(s in 0.01f64..100.0) {
            let numeric = (huber(s + 1e-6, 6.0).0 - huber(s - 1e-6, 6.0).0) / 2e-6;
            prop_assert!((numeric - huber(s, 6.0).1).abs() < 1e-5);
        }
    }
}
