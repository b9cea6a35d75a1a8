//! Tracking of whole frames: a ray-cast textured room with exact truth, and the start of a recording where there is one.

use std::collections::BTreeMap;

use image::{Rgb, RgbImage};
use keysplat::geometry::{Camera, Distortion, Pinhole, Se3, StampedPose, se3};
use keysplat::sequence::{DepthImage, Frame, Sensor, Sequence};
use keysplat::tracking::{KeyframeUpdate, TrackedFrame, Tracker, TrackingConfig, TrackingState};
use nalgebra::{Point3, Vector2, Vector3, Vector6};

const CAMERA: Camera = Camera {
    pinhole: Pinhole { fx: 260.0, fy: 262.0, cx: 161.0, cy: 118.5, width: 320, height: 240 },
    distortion: Distortion { k1: 0.05, k2: -0.03, p1: 0.001, p2: -0.0005, k3: 0.0 },
    depth_units_per_metre: 5000.0,
};
/// The room reaches this far from the origin on each axis, metres.
const HALF_ROOM: [f64; 3] = [2.0, 1.3, 1.8];

/// Grey level of the room's surface: random squares of two sizes.
fn texture(p: &Point3<f64>) -> f64 {
    let cell = |size: f64, seed: u64| {
        let mut hash = seed;
        for v in p.iter() {
            // Half a cell off, so that no wall lies on a border between cells.
            hash = (hash ^ ((v / size + 0.5).floor() as i64 as u64)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            hash ^= hash >> 29;
        }
        (hash % 256) as f64
    };
    0.6 * cell(0.093, 1) + 0.4 * cell(0.031, 2)
}

/// Where a ray from inside the room meets its wall, as a multiple of the direction.
fn wall(origin: &Point3<f64>, direction: &Vector3<f64>) -> f64 {
    let to_wall = |k: usize| (HALF_ROOM[k] * direction[k].signum() - origin[k]) / direction[k];
    (0..3).map(to_wall).fold(f64::INFINITY, f64::min)
}

fn render(index: usize, world_from_camera: &Se3) -> Frame {
    let pinhole = CAMERA.pinhole;
    let ray = |x: f64, y: f64| {
        let ideal = CAMERA.undistort_pixel(&Vector2::new(x, y));
        world_from_camera.rotation * pinhole.unproject(&ideal, 1.0)
    };
    let centre = Point3::from(world_from_camera.translation.vector);
    let color = RgbImage::from_fn(pinhole.width, pinhole.height, |x, y| {
        let sample = |k: u32| {
            let (u, v) = (f64::from(k % 3) / 3.0 - 1.0 / 3.0, f64::from(k / 3) / 3.0 - 1.0 / 3.0);
            let direction = ray(f64::from(x) + u, f64::from(y) + v);
            texture(&(centre + direction * wall(&centre, &direction)))
        };
        Rgb([((0..9).map(sample).sum::<f64>() / 9.0) as u8; 3])
    });
    let metres = (0..pinhole.width * pinhole.height)
        .map(|i| wall(&centre, &ray(f64::from(i % pinhole.width), f64::from(i / pinhole.width))) as f32)
        .collect();
    let depth = Some(DepthImage { width: pinhole.width, height: pinhole.height, metres });
    Frame { index, timestamp_s: index as f64 / 30.0, color, depth, right: None, mask: None }
}

/// A smooth walk through the room.
fn truth(index: usize) -> Se3 {
    walk(index as f64)
}

fn walk(t: f64) -> Se3 {
    se3::exp(&Vector6::new(0.03 * t, 0.01 * (t * 0.7).sin(), 0.015 * t, 0.01 * (t * 0.5).sin(), 0.02 * t, 0.005 * t))
}

fn config() -> TrackingConfig {
    TrackingConfig { features: Some(500), inverse_depth_sigma: 0.005, ..Default::default() }
}

fn tracker() -> Tracker {
    Tracker::new(CAMERA, Sensor::Rgbd, &config()).unwrap()
}

/// Distance and angle between an estimate and the truth, both relative to the first frame.
fn error(estimate: &Se3, index: usize) -> (f64, f64) {
    let off = (truth(0).inverse() * truth(index)).inverse() * estimate;
    (off.translation.vector.norm(), off.rotation.angle())
}

fn assert_close(estimate: &Se3, index: usize) {
    assert_within(estimate, index, 0.006, 0.004);
}

/// Without depth and before a flat wall, moving sideways and turning look much alike.
fn assert_close_without_depth(estimate: &Se3, index: usize) {
    assert_within(estimate, index, 0.02, 0.012);
}

fn assert_within(estimate: &Se3, index: usize, max_metres: f64, max_angle_rad: f64) {
    let (metres, angle_rad) = error(estimate, index);
    assert!(metres < max_metres && angle_rad < max_angle_rad, "frame {index} is off by {metres} m and {angle_rad} rad");
}

/// What was said of each frame, and the updates that came at the end.
type Answers = (Vec<TrackedFrame>, Vec<KeyframeUpdate>);

fn run(mut tracker: Tracker, frames: &[Frame]) -> (Tracker, Answers) {
    let tracked = frames.iter().map(|f| tracker.track(f, f.index % 8 != 4).unwrap()).collect();
    let last = tracker.finish().unwrap();
    assert!(tracker.finish().unwrap().is_empty());
    (tracker, (tracked, last))
}

/// What was handed out adds up to the keyframes' poses.
fn assert_told(tracker: &Tracker, (tracked, last): &Answers) {
    let mut told = BTreeMap::new();
    for t in tracked {
        t.updates.iter().for_each(|update| assert!(told.insert(update.id, update.world_from_camera).is_some()));
        told.extend(t.keyframe.as_ref().map(|k| (k.id, k.world_from_camera)));
    }
    last.iter().for_each(|update| assert!(told.insert(update.id, update.world_from_camera).is_some()));
    let keyframes = tracker.keyframes().into_iter().chain(tracker.image_only_keyframes());
    assert_eq!(told, keyframes.map(|k| (k.frame_index, k.world_from_camera)).collect());
}

#[test]
fn a_walk_through_a_textured_room_is_recovered_the_same_each_time() {
    let frames: Vec<Frame> = (0..16).map(|i| render(i, &truth(i))).collect();
    let (tracker, answers) = run(tracker(), &frames);
    for (index, t) in answers.0.iter().enumerate() {
        assert_eq!(t.state, TrackingState::Tracking);
        assert_close(&t.world_from_camera.unwrap(), index);
        assert!(t.keyframe.is_none() || index % 8 != 4, "frame {index} is held out");
        if let Some(keyframe) = &t.keyframe {
            assert!(keyframe.covisible.is_sorted_by(|a, b| a.1 >= b.1));
            assert!(t.updates.iter().all(|update| update.id < keyframe.id && update.scale == 1.0));
        }
    }
    let trajectory = tracker.trajectory();
    assert_eq!(trajectory.len(), 16);
    trajectory.iter().for_each(|(index, pose)| assert_close(&pose.world_from_camera, *index));
    let keyframes = tracker.keyframes();
    assert!((3..=12).contains(&keyframes.len()), "{} keyframes", keyframes.len());
    assert!(answers.0.iter().any(|t| !t.updates.is_empty()));
    assert_told(&tracker, &answers);

    let (again, same) = run(self::tracker(), &frames);
    assert_eq!(same.1, answers.1);
    for (a, b) in same.0.iter().zip(&answers.0) {
        assert_eq!((a.world_from_camera, &a.keyframe, &a.updates), (b.world_from_camera, &b.keyframe, &b.updates));
    }
    assert_eq!(again.trajectory(), trajectory);
    assert_eq!(again.keyframes(), keyframes);
}

#[test]
fn paced_tracking_takes_adjustments_in_when_they_are_ready() {
    let frames: Vec<Frame> = (0..16).map(|i| render(i, &truth(i))).collect();
    let (tracker, answers) = run(tracker().real_time(true), &frames);
    for (index, pose) in tracker.trajectory() {
        assert_close(&pose.world_from_camera, index);
    }
    assert!(!answers.1.is_empty() || answers.0.iter().any(|t| !t.updates.is_empty()));
    assert_told(&tracker, &answers);
}

#[test]
fn keyframes_close_together_are_culled_and_keep_their_poses() {
    let slow = |i: usize| walk(0.2 * i as f64);
    let frames: Vec<Frame> = (0..40).map(|i| render(i, &slow(i))).collect();
    let run = |keyframe_culling: bool| {
        // A keyframe wherever the camera has moved at all.
        let config = TrackingConfig { keyframe_translation: 0.002, keyframe_rotation_rad: 0.002, keyframe_culling, ..config() };
        let (tracker, answers) = run(Tracker::new(CAMERA, Sensor::Rgbd, &config).unwrap(), &frames);
        for (index, pose) in tracker.trajectory() {
            let off = (slow(0).inverse() * slow(index)).inverse() * pose.world_from_camera;
            assert!(off.translation.vector.norm() < 0.006 && off.rotation.angle() < 0.004, "frame {index}: {off}");
        }
        assert_told(&tracker, &answers);
        (tracker.keyframes().len(), tracker.living_keyframes())
    };
    let (all, culled) = (run(false), run(true));
    assert!(all.0 == all.1 && all.0 > 25 && culled.1 + 5 <= culled.0, "{all:?}, {culled:?}");
}

#[test]
fn blind_frames_are_lost_and_the_camera_is_found_again() {
    let mut tracker = tracker();
    for i in 0..6 {
        tracker.track(&render(i, &truth(i)), true).unwrap();
    }
    tracker.finish().unwrap();
    let keyframes = tracker.keyframes();
    for (i, grey) in [(6, 0), (7, 255), (8, 90)] {
        let mut blind = render(i, &truth(i));
        blind.color.pixels_mut().for_each(|p| *p = Rgb([grey; 3]));
        let tracked = tracker.track(&blind, true).unwrap();
        assert_eq!((tracked.state, tracked.world_from_camera), (TrackingState::Lost, None));
        assert!(tracked.keyframe.is_none() && tracked.updates.is_empty());
    }
    assert_eq!(tracker.keyframes(), keyframes);
    // Back, to where it was some time ago.
    let tracked = tracker.track(&render(9, &truth(2)), true).unwrap();
    assert_eq!(tracked.state, TrackingState::Tracking);
    assert_close(&tracked.world_from_camera.unwrap(), 2);
    let frames: Vec<usize> = tracker.trajectory().iter().map(|(index, _)| *index).collect();
    assert_eq!(frames, [0, 1, 2, 3, 4, 5, 9]);
}

/// A full turn on a small circle, looking outwards, and a little further.
fn turn(index: usize) -> Se3 {
    let angle = index as f64 * 0.1;
    Se3::new(Vector3::zeros(), Vector3::y() * angle) * Se3::translation(0.05 * (0.2 * index as f64).sin(), 0.0, 0.5)
}

#[test]
fn a_closed_loop_takes_the_drift_out() {
    // A focal length that is off by 2% turns a full circle into less than one: drift.
    let mut camera = CAMERA;
    (camera.pinhole.fx, camera.pinhole.fy) = (1.02 * camera.pinhole.fx, 1.02 * camera.pinhole.fy);
    let frames: Vec<Frame> = (0..72).map(|i| render(i, &turn(i))).collect();
    let run = |loop_closing: bool| {
        let config = TrackingConfig { loop_closing, bundle_iterations: 0, ..config() };
        let mut tracker = Tracker::new(camera, Sensor::Rgbd, &config).unwrap();
        let mut moved = 0;
        for (i, frame) in frames.iter().enumerate() {
            let tracked = tracker.track(frame, true).unwrap();
            assert_eq!(tracked.state, TrackingState::Tracking, "frame {i}");
            moved += tracked.updates.len();
        }
        moved += tracker.finish().unwrap().len();
        // The circle is also too wide; that is no drift, and stays.
        let off =
            |(i, pose): &(usize, StampedPose)| (turn(0).inverse() * turn(*i)).rotation.angle_to(&pose.world_from_camera.rotation);
        let trajectory = tracker.trajectory();
        (trajectory.iter().map(off).sum::<f64>() / trajectory.len() as f64, moved, trajectory)
    };
    let (open, closed) = (run(false), run(true));
    assert!(open.0 > 0.02 && closed.0 < 0.3 * open.0, "{} rad against {} rad", closed.0, open.0);
    assert!(open.1 == 0 && closed.1 > 20, "keyframes move only where a loop is closed: {}, {}", open.1, closed.1);
    assert_eq!(run(true).2, closed.2);
}

#[test]
fn a_lost_camera_begins_a_submap_that_joins_when_a_place_is_recognised() {
    // Half a turn is missing, and nothing after it shows what was seen before, until the circle closes.
    let frame = |i: usize| {
        let gap_s = if i < 20 { 0.0 } else { 2.0 };
        let frame = render(i, &turn(i));
        Frame { timestamp_s: frame.timestamp_s + gap_s, ..frame }
    };
    let run = |last: usize| {
        let mut tracker = tracker();
        for i in (0..20).chain(45..last) {
            assert_eq!(tracker.track(&frame(i), true).unwrap().state, TrackingState::Tracking, "frame {i}");
        }
        tracker.finish().unwrap();
        tracker
    };
    let apart = run(52);
    assert_eq!(apart.trajectory().iter().map(|(i, _)| *i).collect::<Vec<_>>(), (0..20).collect::<Vec<_>>());
    let joined = apart.keyframes().into_iter().chain(apart.image_only_keyframes());
    assert!(joined.map(|k| k.frame_index).all(|frame| frame < 20));
    let unjoined = apart.unjoined_keyframes();
    assert!(!unjoined.is_empty() && unjoined.is_sorted() && unjoined.iter().all(|frame| *frame >= 45), "{unjoined:?}");
    let joined = run(72);
    assert!(joined.unjoined_keyframes().is_empty());
    let trajectory = joined.trajectory();
    assert_eq!(trajectory.len(), 20 + 27);
    for (i, pose) in trajectory {
        let off = (turn(0).inverse() * turn(i)).inverse() * pose.world_from_camera;
        assert!(off.translation.vector.norm() < 0.02 && off.rotation.angle() < 0.01, "frame {i}: {off}");
    }
}

#[test]
fn a_strange_place_is_not_taken_for_a_known_one() {
    let mut tracker = tracker();
    for i in 0..3 {
        tracker.track(&render(i, &truth(i)), true).unwrap();
    }
    // The opposite wall.
    let turned = Se3::new(Vector3::zeros(), Vector3::y() * std::f64::consts::PI) * truth(3);
    assert_eq!(tracker.track(&render(3, &turned), true).unwrap().state, TrackingState::Lost);
}

#[test]
fn depth_may_be_missing_or_wrong_but_not_at_the_start() {
    let without = |i: usize| Frame { depth: None, ..render(i, &truth(i)) };
    let refused = tracker().track(&without(0), true).unwrap_err().to_string();
    assert!(refused.contains("frame 0") && refused.contains("depth"), "{refused}");
    let mut tracker = tracker();
    tracker.track(&render(0, &truth(0)), true).unwrap();
    for i in 1..4 {
        let tracked = tracker.track(&without(i), true).unwrap();
        assert_close_without_depth(&tracked.world_from_camera.unwrap(), i);
    }
    let mut wrong = render(4, &truth(4));
    for (k, metres) in wrong.depth.as_mut().unwrap().metres.iter_mut().enumerate() {
        *metres = [f32::NAN, f32::INFINITY, -1.0, 1e-30, 0.0][k % 5];
    }
    let tracked = tracker.track(&wrong, true).unwrap();
    assert_close_without_depth(&tracked.world_from_camera.unwrap(), 4);
}

#[test]
fn a_tilt_of_the_measured_depth_is_found() {
    const TILT: f64 = 0.015;
    let tilted = |index: usize| {
        let mut frame = render(index, &truth(index));
        let depth = frame.depth.as_mut().unwrap();
        for (k, metres) in depth.metres.iter_mut().enumerate() {
            let x = (f64::from(k as u32 % depth.width) - CAMERA.pinhole.cx) / (0.5 * f64::from(depth.width));
            *metres = (1.0 / (1.0 / f64::from(*metres) + TILT * x)) as f32;
        }
        frame
    };
    let frames: Vec<Frame> = (0..40).map(tilted).collect();
    let with = |depth_bias| {
        // Where pixels count more, a tilt does less harm.
        let config = TrackingConfig { features: Some(500), depth_bias, pixel_noise: false, ..Default::default() };
        run(Tracker::new(CAMERA, Sensor::Rgbd, &config).unwrap(), &frames).0
    };
    let (aware, unaware) = (with(true), with(false));
    let found = aware.depth_bias().unwrap().0;
    assert!((found.y - TILT).abs() < 0.3 * TILT && found.x.abs() < 0.2 * TILT && found.z.abs() < 0.3 * TILT, "{found:?}");
    assert_eq!(unaware.depth_bias(), None);
    let worst =
        |tracker: &Tracker| tracker.trajectory().iter().map(|(i, pose)| error(&pose.world_from_camera, *i).0).fold(0.0, f64::max);
    let (aware, unaware) = (worst(&aware), worst(&unaware));
    assert!(aware < 0.6 * unaware, "{aware} {unaware}");
}

#[test]
fn sharp_images_lower_the_noise_of_keypoints() {
    let frames: Vec<Frame> = (0..25).map(|i| render(i, &truth(i))).collect();
    let sigma = |pixel_noise| {
        let config = TrackingConfig { features: Some(500), pixel_noise, ..Default::default() };
        run(Tracker::new(CAMERA, Sensor::Rgbd, &config).unwrap(), &frames).0.pixel_sigma()
    };
    assert_eq!(sigma(false), 1.0);
    assert!((0.5..0.9).contains(&sigma(true)), "{}", sigma(true));
}

#[test]
fn unusable_input_is_refused_in_words() {
    let bad = TrackingConfig { features: Some(0), ..Default::default() };
    assert!(Tracker::new(CAMERA, Sensor::Rgbd, &bad).unwrap_err().to_string().contains("tracking.features"));
    let mut small = render(0, &truth(0));
    small.color = RgbImage::new(32, 24);
    let refused = tracker().track(&small, true).unwrap_err().to_string();
    assert!(refused.contains("32x24") && refused.contains("320x240"), "{refused}");
    // Nothing to start from: lost, until there is.
    let mut tracker = tracker();
    let mut blank = render(0, &truth(0));
    blank.color = RgbImage::new(320, 240);
    assert_eq!(tracker.track(&blank, true).unwrap().state, TrackingState::Lost);
    assert_eq!(tracker.track(&render(1, &truth(1)), false).unwrap().state, TrackingState::Lost);
    let started = tracker.track(&render(2, &truth(2)), true).unwrap();
    assert_eq!(started.world_from_camera, Some(Se3::identity()));
    assert_eq!(started.keyframe.unwrap().id, 2);
}

#[test]
fn the_start_of_redkitchen_is_tracked() {
    let Some(kitchen) = crate::common::requirements::recorded("redkitchen") else { return };
    let sequence = Sequence::open(&kitchen, None, None).unwrap();
    let mut tracker = Tracker::new(sequence.camera, sequence.sensor, &TrackingConfig::default()).unwrap();
    for index in 0..60 {
        let tracked = tracker.track(&sequence.load(index).unwrap(), index % 8 != 7).unwrap();
        assert_eq!(tracked.state, TrackingState::Tracking, "frame {index}");
    }
    // Distances from the first position need no alignment.
    let poses = tracker.trajectory();
    let truth = sequence.groundtruth.unwrap().poses;
    let mut compared = 0;
    for t in &truth {
        let Some((_, p)) = poses.iter().find(|(_, p)| (p.timestamp_s - t.timestamp_s).abs() < 0.01) else { continue };
        let moved = |pose: &Se3, first: &Se3| (pose.translation.vector - first.translation.vector).norm();
        let (ours, theirs) = (
            moved(&p.world_from_camera, &poses[0].1.world_from_camera),
            moved(&t.world_from_camera, &truth[0].world_from_camera),
        );
        assert!((ours - theirs).abs() < 0.02, "{ours} m against {theirs} m at {} s", t.timestamp_s);
        compared += 1;
    }
    assert!(compared >= 14);
}
