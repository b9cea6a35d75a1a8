//! Camera models: a pinhole with OpenCV's radial-tangential distortion.
//!
//! Camera frame: x right, y down, z forward. Pixel coordinates follow OpenCV: the centre of the top-left pixel is `(0, 0)`.

use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A pinhole projection, all in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pinhole {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x; the centre of the first pixel is 0.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Image width.
    pub width: u32,
    /// Image height.
    pub height: u32,
}

impl Pinhole {
    /// The camera of views whose own is not known: 640×480 pixels, 60° wide.
    pub fn assumed() -> Self {
        let (width, height) = (640, 480);
        let focal = 0.5 * f64::from(width) / 30f64.to_radians().tan();
        let centre = |side: u32| 0.5 * (f64::from(side) - 1.0);
        Self { fx: focal, fy: focal, cx: centre(width), cy: centre(height), width, height }
    }

    /// Projects a point in the camera frame (metres) to pixels; `None` at or behind the camera's plane.
    pub fn project(&self, p_in_camera: &Vector3<f64>) -> Option<Vector2<f64>> {
        (p_in_camera.z > 1e-6).then(|| {
            Vector2::new(self.fx * p_in_camera.x / p_in_camera.z + self.cx, self.fy * p_in_camera.y / p_in_camera.z + self.cy)
        })
    }

    /// The point at `depth_metres` (along z) seen at `pixel`, in the camera frame.
    pub fn unproject(&self, pixel: &Vector2<f64>, depth_metres: f64) -> Vector3<f64> {
        Vector3::new((pixel.x - self.cx) / self.fx * depth_metres, (pixel.y - self.cy) / self.fy * depth_metres, depth_metres)
    }

    /// Whether a pixel position falls on the image, `margin` pixels inside its border.
    pub fn contains(&self, pixel: &Vector2<f64>, margin: f64) -> bool {
        pixel.x >= margin
            && pixel.y >= margin
            && pixel.x <= f64::from(self.width) - 1.0 - margin
            && pixel.y <= f64::from(self.height) - 1.0 - margin
    }

    /// The camera of images resized to `scale` times their size (rounded), with pixel centres kept where they belong.
    pub fn scaled(&self, scale: f64) -> Self {
        let width = (f64::from(self.width) * scale).round().max(1.0);
        let height = (f64::from(self.height) * scale).round().max(1.0);
        let (sx, sy) = (width / f64::from(self.width), height / f64::from(self.height));
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: (self.cx + 0.5) * sx - 0.5,
            cy: (self.cy + 0.5) * sy - 0.5,
            width: width as u32,
            height: height as u32,
        }
    }
}

/// OpenCV's distortion (k1, k2, p1, p2, k3), on normalised image coordinates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Distortion {
    /// Radial, second order.
    pub k1: f64,
    /// Radial, fourth order.
    pub k2: f64,
    /// Tangential, along y.
    pub p1: f64,
    /// Tangential, along x.
    pub p2: f64,
    /// Radial, sixth order.
    pub k3: f64,
}

impl Distortion {
    /// Whether the lens has no distortion.
    pub fn is_zero(&self) -> bool {
        *self == Self::default()
    }

    /// Distorts a normalised (z = 1) coordinate.
    pub fn distort(&self, n: &Vector2<f64>) -> Vector2<f64> {
        let r2 = n.norm_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        Vector2::new(
            n.x * radial + 2.0 * self.p1 * n.x * n.y + self.p2 * (r2 + 2.0 * n.x * n.x),
            n.y * radial + self.p1 * (r2 + 2.0 * n.y * n.y) + 2.0 * self.p2 * n.x * n.y,
        )
    }

    /// The inverse of [`Self::distort`], by fixed-point iteration (converges for the lenses this model is meant for).
    pub fn undistort(&self, d: &Vector2<f64>) -> Vector2<f64> {
        if self.is_zero() {
            return *d;
        }
        let mut n = *d;
        for _ in 0..30 {
            let step = d - self.distort(&n);
            n += step;
            if step.norm_squared() < 1e-24 {
                break;
            }
        }
        n
    }
}

/// A recorded camera: its pinhole, its lens, and what one unit of its depth image means.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Projection without the lens.
    pub pinhole: Pinhole,
    /// Distortion of the lens; zero by default.
    #[serde(default)]
    pub distortion: Distortion,
    /// Depth image value of one metre (5000 in TUM's recordings).
    pub depth_units_per_metre: f64,
}

/// Focal length of a usual lens, as a share of the image's larger side.
const USUAL_FOCAL: f64 = 0.9;

impl Camera {
    /// A usual lens without distortion, for images whose camera is not known.
    pub fn assumed(width: u32, height: u32) -> Self {
        let focal = USUAL_FOCAL * f64::from(width.max(height));
        let (cx, cy) = (f64::from(width) / 2.0 - 0.5, f64::from(height) / 2.0 - 0.5);
        let pinhole = Pinhole { fx: focal, fy: focal, cx, cy, width, height };
        Self { pinhole, distortion: Distortion::default(), depth_units_per_metre: 1000.0 }
    }

    /// Recorded pixel → pixel of the distortion-free pinhole with the same intrinsics.
    pub fn undistort_pixel(&self, pixel: &Vector2<f64>) -> Vector2<f64> {
        if self.distortion.is_zero() {
            return *pixel;
        }
        let p = &self.pinhole;
        let n = self.distortion.undistort(&Vector2::new((pixel.x - p.cx) / p.fx, (pixel.y - p.cy) / p.fy));
        Vector2::new(n.x * p.fx + p.cx, n.y * p.fy + p.cy)
    }

    /// Pixel of the distortion-free pinhole → recorded pixel.
    pub fn distort_pixel(&self, pixel: &Vector2<f64>) -> Vector2<f64> {
        if self.distortion.is_zero() {
            return *pixel;
        }
        let p = &self.pinhole;
        let d = self.distortion.distort(&Vector2::new((pixel.x - p.cx) / p.fx, (pixel.y - p.cy) / p.fy));
        Vector2::new(d.x * p.fx + p.cx, d.y * p.fy + p.cy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PINHOLE: Pinhole = Pinhole { fx: 517.3, fy: 516.5, cx: 318.6, cy: 255.3, width: 640, height: 480 };

    proptest! {
        #[test]
        fn undistortion_inverts_distortion(x in 0.0f64..640.0, y in 0.0f64..480.0) {
            let camera = Camera {
                pinhole: PINHOLE,
                distortion: Distortion { k1: 0.2624, k2: -0.9531, p1: -0.0054, p2: 0.0026, k3: 1.1633 },
                depth_units_per_metre: 5000.0,
            };
            let pixel = Vector2::new(x, y);
            prop_assert!((camera.distort_pixel(&camera.undistort_pixel(&pixel)) - pixel).norm() < 1e-3);
        }

        #[test]
        fn unprojection_inverts_projection(x in -100.0f64..740.0, y in -100.0f64..580.0, z in 0.1f64..50.0) {
            let pixel = Vector2::new(x, y);
            let back = PINHOLE.project(&PINHOLE.unproject(&pixel, z)).unwrap();
            prop_assert!((back - pixel).norm() < 1e-9);
        }
    }

    #[test]
    fn scaling_keeps_the_image_corners_in_place() {
        let half = PINHOLE.scaled(0.5);
        // The outer corner of the image, (-0.5, -0.5), is the same ray at every scale.
        let ray = |p: &Pinhole| ((-0.5 - p.cx) / p.fx, (-0.5 - p.cy) / p.fy);
        assert!((ray(&PINHOLE).0 - ray(&half).0).abs() < 1e-12 && (ray(&PINHOLE).1 - ray(&half).1).abs() < 1e-12);
        assert_eq!((half.width, half.height), (320, 240));
        assert_eq!((half.fx, half.fy), (PINHOLE.fx / 2.0, PINHOLE.fy / 2.0));
        let odd = PINHOLE.scaled(0.001);
        assert_eq!((odd.width, odd.height), (1, 1));
    }

    #[test]
    fn the_image_reaches_to_the_centres_of_its_outer_pixels() {
        let contains = |x: f64, y: f64, margin: f64| PINHOLE.contains(&Vector2::new(x, y), margin);
        assert!(
            contains(0.0, 0.0, 0.0) && contains(639.0, 479.0, 0.0) && contains(10.0, 10.0, 10.0) && contains(629.0, 469.0, 10.0)
        );
        for (x, y) in [(-0.01, 240.0), (320.0, -0.01), (639.01, 240.0), (320.0, 479.01), (f64::NAN, 240.0)] {
            assert!(!contains(x, y, 0.0), "{x} {y}");
        }
        for (x, y) in [(9.9, 240.0), (320.0, 9.9), (629.1, 240.0), (320.0, 469.1)] {
            assert!(!contains(x, y, 10.0) && contains(x, y, 9.0), "{x} {y}");
        }
    }

    #[test]
    fn what_lies_in_the_plane_of_the_camera_has_no_pixel() {
        let project = |z: f64| PINHOLE.project(&Vector3::new(0.1, 0.1, z));
        assert!(project(2e-6).is_some() && [1e-6, 0.0, -1.0, f64::NAN].iter().all(|z| project(*z).is_none()));
    }

    #[test]
    fn each_coefficient_distorts() {
        assert!(Distortion::default().is_zero());
        let [a, b, c, d, e] = std::array::from_fn(|i| {
            let k: [f64; 5] = std::array::from_fn(|j| f64::from(u8::from(i == j)) * 0.1);
            Distortion { k1: k[0], k2: k[1], p1: k[2], p2: k[3], k3: k[4] }
        });
        let at = Vector2::new(0.3, -0.2);
        let r2: f64 = 0.13;
        // Brown–Conrady, term by term (OpenCV's `undistortPoints`).
        let expected = [
            at * (1.0 + 0.1 * r2),
            at * (1.0 + 0.1 * r2 * r2),
            at + Vector2::new(2.0 * 0.1 * at.x * at.y, 0.1 * (r2 + 2.0 * at.y * at.y)),
            at + Vector2::new(0.1 * (r2 + 2.0 * at.x * at.x), 2.0 * 0.1 * at.x * at.y),
            at * (1.0 + 0.1 * r2 * r2 * r2),
        ];
        for (lens, expected) in [a, b, c, d, e].iter().zip(expected) {
            assert!(!lens.is_zero() && (lens.distort(&at) - expected).norm() < 1e-15, "{lens:?}");
        }
    }
}
