use std::sync::Arc;

use super::*;
use crate::geometry::{Sim3, se3};
use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::features::frame_features::tests::feature;
use crate::tracking::loop_closing::tests::drifted;
use crate::tracking::map::sparse_map::{Keyframe, LandmarkState};
use crate::tracking::solvers::residual::tests::PINHOLE;
use nalgebra::{Matrix6, Point3, Vector6};

#[test]
fn a_result_is_taken_into_a_map_that_has_gone_on() {
    let config = TrackingConfig::default();
    let mut map = drifted(&Sim3::identity(), true, &config);
    let last = map.keyframes.len() - 1;
    let mut window = Adjustment::of_window(&map, last, &Rig::new(PINHOLE, config.clone())).unwrap();
    let gone = window.landmarks[3];
    map.remove_landmark(gone);
    window.problem.observations.iter_mut().filter(|o| o.point == 3).for_each(|o| o.class = InlierClass::Outlier);
    // A newer keyframe sees what the last one saw, and one landmark of its own.
    let newer = map.keyframes.len();
    let seen = map.keyframes[last].landmarks.clone();
    map.push(Keyframe { landmarks: vec![None; seen.len()], ..map.keyframes[last].clone() });
    for (feature, landmark) in seen.into_iter().enumerate().skip(1) {
        landmark.into_iter().for_each(|l| map.add_observation(l, Observation { keyframe: newer, feature }));
    }
    let own = map.add_landmark(Observation { keyframe: newer, feature: 0 }, Point3::new(1.0, 2.0, 3.0), &config);
    let pose = map.keyframes[newer].camera_from_world;
    // As if all that is free had been moved alike.
    let push = se3::exp(&Vector6::new(0.02, -0.01, 0.03, 0.01, 0.02, -0.02));
    window.problem.poses.iter_mut().for_each(|p| *p *= push);
    let moved = window.apply(&mut map, &config);
    assert!(moved.contains(&last) && moved.contains(&newer) && !moved.contains(&0) && moved.is_sorted());
    assert!(se3::log(&(map.keyframes[newer].camera_from_world * (pose * push).inverse())).norm() < 1e-12);
    assert!((map.position(own) - push.inverse() * Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
    assert!(map.landmarks[gone].state == LandmarkState::Removed && map.landmarks[gone].observations.is_empty());
}

#[test]
fn a_keyframe_that_came_since_stays_with_one_that_stays() {
    let config = TrackingConfig { window_keyframes: 2, ..Default::default() };
    let mut map = drifted(&Sim3::identity(), true, &config);
    let mut window = Adjustment::of_window(&map, 1, &Rig::new(PINHOLE, config.clone())).unwrap();
    // It shares landmarks with the last keyframe, which the window has not moved, or with none.
    let last = map.keyframes.len() - 1;
    let newer = [true, false].map(|shares| {
        let newer =
            map.push(Keyframe { landmarks: vec![None; map.keyframes[last].landmarks.len()], ..map.keyframes[last].clone() });
        for (feature, landmark) in map.keyframes[last].landmarks.clone().into_iter().enumerate().filter(|_| shares) {
            landmark.into_iter().for_each(|l| map.add_observation(l, Observation { keyframe: newer, feature }));
        }
        newer
    });
    let push = Se3::translation(0.1, 0.0, 0.0);
    window.problem.poses.iter_mut().for_each(|p| *p *= push);
    let moved = window.apply(&mut map, &config);
    assert!(moved.contains(&1) && !moved.contains(&last) && newer.iter().all(|k| !moved.contains(k)), "{moved:?}");
}

#[test]
fn frames_are_unknowns_beside_the_keyframes() {
    let config = TrackingConfig::default();
    let rig = Rig::new(PINHOLE, config.clone());
    let mut map = drifted(&Sim3::identity(), true, &config);
    let truth: Vec<Se3> = map.keyframes.iter().map(|k| k.camera_from_world).collect();
    let off = |k: usize| se3::exp(&(Vector6::new(0.01, -0.005, 0.01, 0.003, 0.002, -0.004) * (0.5 - (k % 3) as f64)));
    // Each sees what a keyframe does, from where that is in truth.
    let frame = |k: usize| {
        let keyframe = &map.keyframes[k];
        let pairs = keyframe.features.features.iter().zip(&keyframe.landmarks);
        FrameView {
            camera_from_world: off(k + 1) * truth[k],
            seen: pairs.filter_map(|(f, l)| Some(((*l)?, rig.biased_measurement(f)))).collect(),
            relative_pose: None,
        }
    };
    let mut frames: Vec<FrameView> = (1..5).map(frame).collect();
    // One sees nothing, and is where its pixels put it beside the last keyframe, which holds it in another place of the problem.
    let (last, relative) = (truth.len() - 1, se3::exp(&Vector6::new(0.1, 0.02, -0.05, 0.01, -0.04, 0.02)));
    let information = Matrix6::identity() * 1e4;
    let of_last = RelativePose { current: 0, reference: last, current_from_reference: relative, information };
    frames.push(FrameView { camera_from_world: truth[last], seen: Vec::new(), relative_pose: Some(of_last) });
    (1..truth.len()).for_each(|k| map.set_pose(k, off(k) * truth[k]));
    let mut all = Adjustment::of_all(&map, 0, usize::MAX, &rig).unwrap().with_frames(&frames);
    all.solve(&PINHOLE, 10);
    all.apply(&mut map, &config);
    let error = |pose: &Se3, k: usize| se3::log(&(pose * truth[k].inverse())).norm();
    let worst = (1..truth.len()).map(|k| error(&map.keyframes[k].camera_from_world, k)).fold(0.0, f64::max);
    assert!(worst < 1e-3, "{worst}");
    let of_frames = &all.problem.poses[all.free_keyframes..all.problem.free_poses];
    for (k, pose) in (1..5).zip(of_frames) {
        assert!(error(pose, k) < 1e-3, "{k}: {}", error(pose, k));
    }
    assert!(error(&(relative.inverse() * of_frames[4]), last) < 1e-3, "{}", of_frames[4]);
}

#[test]
fn a_keyframe_without_landmarks_goes_where_its_relative_pose_puts_it() {
    let config = TrackingConfig::default();
    let rig = Rig::new(PINHOLE, config.clone());
    let mut map = drifted(&Sim3::identity(), true, &config);
    let reference = map.keyframes.len() - 1;
    let mut bare = map.keyframes[reference].clone();
    bare.landmarks.fill(None);
    let current_from_reference = se3::exp(&Vector6::new(0.1, 0.02, -0.05, 0.01, -0.04, 0.02));
    let relative = |current, information| {
        let information = Matrix6::identity() * information;
        vec![RelativePose { current, reference, current_from_reference, information }]
    };
    let tied = map.push(Keyframe { relative_poses: relative(reference + 1, 1e4), ..bare.clone() });
    let untied = map.push(bare);
    let adjustments = [Adjustment::of_window(&map, tied, &rig), Adjustment::of_all(&map, 0, usize::MAX, &rig)];
    for adjustment in adjustments {
        let mut adjustment = adjustment.unwrap();
        let mut map = map.clone();
        adjustment.solve(&PINHOLE, 10);
        adjustment.apply(&mut map, &config);
        let pose = |k: usize| map.keyframes[k].camera_from_world;
        let found = pose(tied) * pose(reference).inverse();
        assert!(se3::log(&(found * current_from_reference.inverse())).norm() < 1e-4, "{found}");
    }
    assert!(Adjustment::of_window(&map, untied, &rig).is_none());
}

/// Three keyframes: the last two share thirty landmarks, the first two so many.
fn chain(shared: usize) -> Map {
    let mut map = Map::default();
    let list = (0..70).map(|i| feature(8.0 * f64::from(i), 100.0, Descriptor([1 << (i % 64), 0, 0, 0]))).collect();
    let features = Arc::new(FrameFeatures::new(list, &PINHOLE));
    for k in 0..3 {
        map.push(Keyframe::new(k, k as f64, Se3::translation(-0.1 * k as f64, 0.0, 0.0), features.clone()));
    }
    for (first, features) in [(0, 0..shared), (1, 40..70)] {
        for feature in features {
            let at = Point3::new(0.02 * feature as f64, 0.0, 2.0);
            let landmark = map.add_landmark(Observation { keyframe: first, feature }, at, &TrackingConfig::default());
            map.add_observation(landmark, Observation { keyframe: first + 1, feature });
        }
    }
    map
}

#[test]
fn a_window_that_few_landmarks_tie_keeps_its_oldest_keyframe() {
    let config = TrackingConfig::default();
    assert_eq!(choose_window(&chain(MIN_SHARED), 2, &config), (vec![2, 1], vec![0]));
    assert_eq!(choose_window(&chain(MIN_SHARED - 1), 2, &config), (vec![2], vec![1, 0]));
    assert_eq!(choose_window(&chain(0), 2, &config), (vec![2], vec![1]));
}
