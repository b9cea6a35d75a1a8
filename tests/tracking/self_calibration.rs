//! Cameras without a calibration.

use keysplat::geometry::Camera;
use keysplat::sequence::{Frame, Sensor, Sequence};
use keysplat::tracking::{ExtractedFrame, FrontEnd, SelfCalibrationError, TrackingConfig, self_calibrate};

use crate::common::requirements::recorded;

/// Frames of the kitchen as a camera takes them of which nothing is known.
fn extracted(frames: impl Iterator<Item = Frame>) -> (Vec<ExtractedFrame>, TrackingConfig) {
    let config = TrackingConfig::default();
    let front_end = FrontEnd::new(Camera::assumed(640, 480), Sensor::Mono, &config);
    (frames.map(|frame| front_end.extract(&frame).unwrap()).collect(), config)
}

#[test]
fn the_focal_length_of_the_kitchen_is_found() {
    let Some(kitchen) = recorded("redkitchen") else { return };
    let sequence = Sequence::open(&kitchen, None, None).unwrap();
    let (frames, config) = extracted((0..400).map(|index| sequence.load(index).unwrap()));
    let found = self_calibrate(&frames, (640, 480), &config).unwrap();
    let error = found.camera.pinhole.fx / sequence.camera.pinhole.fx - 1.0;
    assert!(error.abs() < 0.02, "{:.2}% off: {found:?}", 100.0 * error);
    let second = found.camera.distortion.k2 - sequence.camera.distortion.k2;
    assert!(second.abs() < 0.05, "{found:?}");
    assert!(found.focal_sigma > 0.5 && error.abs() * found.camera.pinhole.fx < 3.0 * found.focal_sigma, "{found:?}");
}

#[test]
fn a_camera_that_does_not_move_says_nothing_of_its_lens() {
    let Some(kitchen) = recorded("redkitchen") else { return };
    let sequence = Sequence::open(&kitchen, None, None).unwrap();
    let still = sequence.load(0).unwrap();
    let at = |index: usize| Frame { index, timestamp_s: index as f64 / 30.0, ..still.clone() };
    let (frames, config) = extracted((0..20).map(at));
    let refused = self_calibrate(&frames, (640, 480), &config).unwrap_err();
    assert!(matches!(refused, SelfCalibrationError::NotTracked), "{refused}");
    assert!(matches!(self_calibrate(&[], (640, 480), &config), Err(SelfCalibrationError::NotTracked)));
}
