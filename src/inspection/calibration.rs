//! Whether a calibration can be that of the images.

use nalgebra::Vector2;

use super::Inspection;
use crate::geometry::Camera;
use crate::sequence::{Sensor, Sequence};

/// Horizontal fields of view of usual lenses, degrees.
const FIELD_OF_VIEW: std::ops::Range<f64> = 25.0..130.0;
/// Largest distance of the principal point from the image's centre, as a share of the image.
const OFF_CENTRE: f64 = 0.15;
/// Largest ratio of the two focal lengths.
const SQUARE_PIXELS: f64 = 1.1;
/// Undistortion must return a corner to within so many pixels.
const FOLDED_PIXELS: f64 = 1.0;

pub fn inspect(sequence: &Sequence, found: &mut Inspection) {
    let camera = &sequence.camera;
    let p = &camera.pinhole;
    let (across, down) = (field_of_view(p.width, p.fx), field_of_view(p.height, p.fy));
    let lens = if camera.distortion.is_zero() { "no distortion" } else { "with distortion" };
    let others = sequence.entries.iter().filter(|entry| entry.camera.is_some()).count();
    let others = if others > 0 { format!("; {others} frames have another camera") } else { String::new() };
    found.fact(
        "calibration",
        format!(
            "{}x{}, focal length {:.1}, {:.1}, field of view {across:.0}° x {down:.0}°, {lens}{others}",
            p.width, p.height, p.fx, p.fy
        ),
    );
    if let Sensor::Stereo { baseline_metres } = sequence.sensor {
        found.fact("baseline", format!("{baseline_metres:.4} m"));
    }
    doubts(camera).into_iter().for_each(|doubt| found.warn(doubt));
}

fn field_of_view(pixels: u32, focal: f64) -> f64 {
    2.0 * (f64::from(pixels) / (2.0 * focal)).atan().to_degrees()
}

/// What no usual camera has.
fn doubts(camera: &Camera) -> Vec<String> {
    let p = &camera.pinhole;
    let (width, height) = (f64::from(p.width), f64::from(p.height));
    let mut doubts = Vec::new();
    let across = field_of_view(p.width, p.fx);
    if !FIELD_OF_VIEW.contains(&across) {
        doubts.push(format!(
            "a focal length of {:.1} pixels gives {} pixels a field of view of {across:.0}°: it may belong to another image size",
            p.fx, p.width
        ));
    }
    if (p.cx - width / 2.0).abs() > OFF_CENTRE * width || (p.cy - height / 2.0).abs() > OFF_CENTRE * height {
        doubts.push(format!(
            "the principal point ({:.1}, {:.1}) is far from the centre of {}x{} pixels: it may belong to another image size",
            p.cx, p.cy, p.width, p.height
        ));
    }
    if p.fx.max(p.fy) > SQUARE_PIXELS * p.fx.min(p.fy) {
        doubts.push(format!("the focal lengths {:.1} and {:.1} differ: pixels are usually square", p.fx, p.fy));
    }
    let corners = [(0.0, 0.0), (width - 1.0, 0.0), (0.0, height - 1.0), (width - 1.0, height - 1.0)];
    let folds = corners.iter().any(|(x, y)| {
        let corner = Vector2::new(*x, *y);
        let off = (camera.distort_pixel(&camera.undistort_pixel(&corner)) - corner).norm();
        off.is_nan() || off > FOLDED_PIXELS
    });
    if folds {
        doubts.push(
            "the distortion has no inverse at the image's corners: its coefficients may be of another model or order".into(),
        );
    }
    doubts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Distortion, Pinhole};

    #[test]
    fn a_usual_camera_raises_no_doubt_and_each_error_its_own() {
        let pinhole = Pinhole { fx: 525.0, fy: 527.0, cx: 319.0, cy: 241.0, width: 640, height: 480 };
        let kinect = Camera {
            pinhole,
            distortion: Distortion { k1: 0.2624, k2: -0.9531, p1: -0.0054, p2: 0.0026, k3: 1.1633 },
            depth_units_per_metre: 5000.0,
        };
        assert!(doubts(&kinect).is_empty(), "{:?}", doubts(&kinect));
        let with = |pinhole| doubts(&Camera { pinhole, ..kinect });
        let first = |pinhole, word: &str| assert!(with(pinhole)[0].contains(word), "{:?}", with(pinhole));
        first(Pinhole { fx: 2100.0, fy: 2108.0, ..pinhole }, "field of view");
        first(Pinhole { cx: 640.0, ..pinhole }, "principal point");
        first(Pinhole { fy: 700.0, ..pinhole }, "square");
        let fisheye = Camera { distortion: Distortion { k1: -2.0, k2: 0.5, ..Distortion::default() }, ..kinect };
        assert!(doubts(&fisheye)[0].contains("distortion"));
    }
}
