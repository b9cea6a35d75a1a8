//! The lens of a `transforms.json`, of the whole file or of one frame.

use serde::Deserialize;

use crate::geometry::{Camera, Distortion, Pinhole};
use crate::sequence::checks;

/// Pixels, and radians across the whole image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct Lens {
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

impl Lens {
    /// This frame's lens in a file: what it leaves out is the file's. Focal lengths and angles belong together.
    pub fn or(&self, file: &Self) -> Self {
        let has_focal = self.fl_x.is_some() || self.camera_angle_x.is_some();
        let focal = if has_focal { self } else { file };
        Self {
            camera_angle_x: focal.camera_angle_x,
            camera_angle_y: focal.camera_angle_y,
            fl_x: focal.fl_x,
            fl_y: focal.fl_y,
            cx: self.cx.or(file.cx),
            cy: self.cy.or(file.cy),
            w: self.w.or(file.w),
            h: self.h.or(file.h),
            k1: self.k1.or(file.k1),
            k2: self.k2.or(file.k2),
            k3: self.k3.or(file.k3),
            k4: self.k4.or(file.k4),
            p1: self.p1.or(file.p1),
            p2: self.p2.or(file.p2),
        }
    }

    /// Whether it says the size of its photos.
    pub fn is_sized(&self) -> bool {
        self.w.is_some() && self.h.is_some()
    }

    /// The camera of photos of that size, if the lens does not say its own.
    pub fn camera(&self, (width, height): (u32, u32), depth_units_per_metre: f64) -> Result<Camera, String> {
        let (w, h) = (self.w.unwrap_or(f64::from(width)), self.h.unwrap_or(f64::from(height)));
        let side = |pixels: f64| {
            let whole = (pixels.fract() == 0.0 && pixels > 0.0).then_some(pixels as u64);
            whole.and_then(checks::side).ok_or_else(|| format!("{pixels} pixels are no size of an image"))
        };
        let focal_of_angle = |angle_rad: f64, pixels: f64| pixels / 2.0 / (angle_rad / 2.0).tan();
        let fx = self.fl_x.or_else(|| self.camera_angle_x.map(|angle_rad| focal_of_angle(angle_rad, w)));
        let fx = fx.ok_or("there is neither fl_x nor camera_angle_x")?;
        let fy = self.fl_y.or_else(|| self.camera_angle_y.map(|angle_rad| focal_of_angle(angle_rad, h))).unwrap_or(fx);
        if self.k4.is_some_and(|k4| k4 != 0.0) {
            return Err("lenses with k4 are not known here; undistort the photos first".into());
        }
        let (cx, cy) = (self.cx.unwrap_or(w / 2.0) - 0.5, self.cy.unwrap_or(h / 2.0) - 0.5);
        let pinhole = Pinhole { fx, fy, cx, cy, width: side(w)?, height: side(h)? };
        let [k1, k2, p1, p2, k3] = [self.k1, self.k2, self.p1, self.p2, self.k3].map(Option::unwrap_or_default);
        checks::camera(Camera { pinhole, distortion: Distortion { k1, k2, p1, p2, k3 }, depth_units_per_metre })
    }
}
