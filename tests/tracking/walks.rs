//! Simulated walks: long ways, places that return and places that only look alike.

use keysplat::evaluation::{Alignment, evaluate_trajectory};
use keysplat::geometry::{StampedPose, Trajectory};
use keysplat::tracking::{Tracker, TrackingConfig};
use keysplat::verification::walk::{Walk, World};

struct Walked {
    tracker: Tracker,
    lost: usize,
    ate_rmse_m: f64,
    wrong_loops: usize,
}

fn walk(world: World, frames: usize, config: &TrackingConfig) -> Walked {
    let mut walk = Walk::new(world, 1, config);
    let mut tracker = Tracker::new(Walk::camera(), world.sensor(), config).unwrap();
    let mut truth = Trajectory::default();
    for _ in 0..frames {
        let (frame, world_from_camera) = walk.frame();
        truth.poses.push(StampedPose { timestamp_s: frame.timestamp_s(), world_from_camera });
        tracker.track_extracted(&frame, true).unwrap();
    }
    tracker.finish().unwrap();
    let wrong_loops = world.wrong_loops(&tracker, &truth);
    let poses: Vec<StampedPose> = tracker.trajectory().into_iter().map(|(_, pose)| pose).collect();
    let lost = frames - poses.len();
    let ate_rmse_m = evaluate_trajectory(&truth, &Trajectory { poses }, Alignment::Rigid).unwrap().ate_rmse_m;
    Walked { tracker, lost, ate_rmse_m, wrong_loops }
}

#[test]
fn a_walk_through_rooms_is_followed_within_its_memory() {
    let bounded = TrackingConfig { max_host_bytes: 10 << 20, ..TrackingConfig::default() };
    let Walked { tracker, lost, ate_rmse_m, wrong_loops } = walk(World::Rooms, 1600, &bounded);
    assert_eq!((lost, wrong_loops), (0, 0));
    assert!(ate_rmse_m < 0.1 && !tracker.loops().is_empty(), "{ate_rmse_m} m, {} loops", tracker.loops().len());
    let megabytes = tracker.map_bytes() as f64 / f64::from(1 << 20);
    assert!(megabytes < 11.0, "{megabytes} MB");
}

#[test]
fn halls_that_look_alike_are_not_taken_for_each_other() {
    let Walked { tracker, lost, ate_rmse_m, wrong_loops } = walk(World::Corridor, 3300, &TrackingConfig::default());
    assert_eq!((lost, wrong_loops), (0, 0));
    assert!(ate_rmse_m < 0.2 && !tracker.loops().is_empty(), "{ate_rmse_m} m, {} loops", tracker.loops().len());
}
