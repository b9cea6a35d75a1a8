//! A made-up walk round a hall, drifted on purpose: the closed loop must bring it back, with known scale and without.

use std::sync::Arc;

use nalgebra::{Point3, Vector3, Vector6};

use crate::geometry::sim3::{self, Vector7};
use crate::geometry::{Se3, Sim3, align, se3};
use crate::tracking::TrackingConfig;
use crate::tracking::adjustment::local_bundle::Adjustment;
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::localisation::dense_alignment::tests::corner;
use crate::tracking::loop_closing::{LoopCloser, MovedKeyframe};
use crate::tracking::map::sparse_map::{Keyframe, Map, Observation};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose_graph::Edge;
use crate::tracking::solvers::residual::tests::PINHOLE;

const STATIONS: usize = 48;
/// Keyframes past the first round.
const BEYOND: usize = 6;

/// camera_from_world on a circle of 2 m in a round hall of 5 m, looking outwards, a little higher in the second round.
fn station(k: usize) -> Se3 {
    let angle = k as f64 / STATIONS as f64 * std::f64::consts::TAU;
    let height = if k < STATIONS { 0.0 } else { 0.1 };
    (Se3::new(Vector3::zeros(), Vector3::y() * angle) * Se3::translation(0.0, height, 2.0)).inverse()
}

/// Points of the hall's wall, each with a descriptor of its own.
fn wall() -> Vec<(Point3<f64>, Descriptor)> {
    let mut random = fastrand::Rng::with_seed(8);
    let mut point = || {
        let (angle, y) = (std::f64::consts::TAU * random.f64(), 3.0 * random.f64() - 1.5);
        let radius = 4.5 + random.f64();
        let at = Point3::new(radius * angle.sin(), y, radius * angle.cos());
        (at, Descriptor(std::array::from_fn(|_| random.u64(..))))
    };
    (0..2500).map(|_| point()).collect()
}

/// What a station sees: features with the wall's points that they show.
fn view(k: usize, wall: &[(Point3<f64>, Descriptor)], with_depth: bool) -> (Vec<Feature>, Vec<usize>) {
    let seen = wall.iter().enumerate().filter_map(|(i, (p, descriptor))| {
        let p_in_camera = (station(k) * p).coords;
        let pixel = PINHOLE.project(&p_in_camera).filter(|pixel| PINHOLE.contains(pixel, 0.0))?;
        let depth_metres = with_depth.then_some(p_in_camera.z);
        Some((Feature { pixel, octave: 2, angle_rad: 0.0, depth_metres, inverse_depth_sigma: 0.025, descriptor: *descriptor }, i))
    });
    seen.unzip()
}

/// The walk as a tracker with a drift of `step` from keyframe to keyframe would have mapped it: landmarks lie where the keyframe that
/// first saw them put them, and are forgotten after a few keyframes.
pub(crate) fn drifted(step: &Sim3, with_depth: bool, config: &TrackingConfig) -> Map {
    let wall = wall();
    let mut map = Map::default();
    let mut known: Vec<Option<(usize, usize)>> = vec![None; wall.len()];
    let mut drifted = Sim3::from(station(0));
    for id in 0..STATIONS + BEYOND {
        if id > 0 {
            drifted = *step * Sim3::from(station(id) * station(id - 1).inverse()) * drifted;
        }
        let (features, points) = view(id, &wall, with_depth);
        let features = Arc::new(FrameFeatures::new(features, &PINHOLE));
        map.push(Keyframe::new(id, id as f64, drifted.to_rigid(), features));
        for (feature, point) in points.into_iter().enumerate() {
            let observation = Observation { keyframe: id, feature };
            match known[point].filter(|(_, last)| last + 3 > id) {
                Some((landmark, _)) => {
                    map.add_observation(landmark, observation);
                    known[point] = Some((landmark, id));
                }
                None => {
                    let position = drifted.inverse().act(&(station(id) * wall[point].0));
                    known[point] = Some((map.add_landmark(observation, position, config), id));
                }
            }
        }
    }
    (0..map.landmarks.len()).for_each(|l| map.refresh_geometry(l, config));
    (0..map.keyframes.len()).for_each(|k| map.refresh_links(k));
    map
}

/// Closes a loop at once.
fn close(closer: &mut LoopCloser, map: &mut Map, keyframe: usize, config: &TrackingConfig) -> Vec<MovedKeyframe> {
    let rig = Rig::new(PINHOLE, config.clone());
    let Some(mut correction) = closer.recognise(map, keyframe, &rig) else { return Vec::new() };
    correction.solve();
    closer.apply(&correction, map, &rig)
}

/// Largest distance between a keyframe's centre and its true one, metres, after alignment (with scale where it is free).
fn off_metres(map: &Map, scale_is_free: bool) -> f64 {
    let centres: Vec<_> = map.keyframes.iter().map(|k| k.centre().coords).collect();
    let truth: Vec<_> = (0..centres.len()).map(|k| station(k).inverse().translation.vector).collect();
    let aligned = align(&centres, &truth, scale_is_free).unwrap();
    centres.iter().zip(&truth).map(|(c, t)| (aligned.act(&(*c).into()).coords - t).norm()).fold(0.0, f64::max)
}

#[test]
fn a_loop_is_closed_with_and_without_scale() {
    let config = TrackingConfig { bundle_iterations: 10, ..Default::default() };
    for (growth, with_depth) in [(0.0, true), (0.004, false)] {
        let step = sim3::exp(&Vector7::from_column_slice(&[0.004, 0.001, -0.003, 0.001, 0.003, 0.0005, growth]));
        let mut map = drifted(&step, with_depth, &config);
        let (newest, before) = (map.keyframes.len() - 1, off_metres(&map, !with_depth));
        assert!(before > 0.1 && map.covisible(newest).iter().all(|(k, _)| *k > 20), "{before} m");
        let mut again = map.clone();
        let moved = close(&mut LoopCloser::default(), &mut map, newest, &config);
        let mut all = Adjustment::of_all(&map, 0, usize::MAX, &Rig::new(PINHOLE, config.clone())).unwrap();
        all.solve(&PINHOLE, config.bundle_iterations);
        all.apply(&mut map, &config);
        assert_eq!(moved.iter().map(|m| m.keyframe).collect::<Vec<_>>(), (1..=newest).collect::<Vec<_>>());
        assert!(moved.iter().all(|m| if with_depth { m.growth == 1.0 } else { (0.7..1.3).contains(&m.growth) }));
        let after = off_metres(&map, !with_depth);
        assert!(after < 0.25 * before, "{before} m → {after} m with depth: {with_depth}");
        assert!(map.covisible(newest).iter().any(|(k, shared)| *k < 10 && *shared > 50), "both ends of the loop are joined");

        close(&mut LoopCloser::default(), &mut again, newest, &config);
        all.apply(&mut again, &config);
        assert_eq!(again.keyframes[newest].camera_from_world, map.keyframes[newest].camera_from_world);
    }
}

#[test]
fn no_loop_is_seen_where_there_is_none() {
    let config = TrackingConfig::default();
    let mut map = drifted(&Sim3::identity(), true, &config);
    let mut closer = LoopCloser::default();
    // Half way round; and a drift that nobody would believe.
    assert!(close(&mut closer, &mut map, STATIONS / 2, &config).is_empty());
    let newest = map.keyframes.len() - 1;
    for keyframe in &mut map.keyframes[STATIONS - 4..] {
        keyframe.camera_from_world = Se3::translation(30.0, 0.0, 0.0) * keyframe.camera_from_world;
    }
    assert!(close(&mut closer, &mut map, newest, &config).is_empty());
}

#[test]
fn submaps_that_show_one_place_become_one() {
    let config = TrackingConfig::default();
    for (scale, with_depth) in [(1.0, true), (1.25, false)] {
        let mut map = drifted(&Sim3::identity(), with_depth, &config);
        let first = map.keyframes.len();
        let mut again = drifted(&Sim3::identity(), with_depth, &config);
        again.keyframes.iter_mut().for_each(|k| k.camera_from_world.translation.vector *= scale);
        again.landmarks.iter_mut().for_each(|l| l.in_anchor.coords *= scale);
        map.append(again, &Se3::new(Vector3::new(300.0, 2.0, 1.0), Vector3::new(0.1, 0.3, 0.2)), &config);
        let newest = map.keyframes.len() - 1;
        assert!(!map.is_connected() && map.is_root(first) && map.connects(first, newest) && !map.connects(0, newest));
        let moved = close(&mut LoopCloser::default(), &mut map, newest, &config);
        assert_eq!(moved.iter().map(|m| m.keyframe).collect::<Vec<_>>(), (first..=newest).collect::<Vec<_>>());
        assert!(moved.iter().all(|m| (m.growth * scale - 1.0).abs() < 0.01));
        assert!(map.is_connected());
        let off = (0..first).map(|k| (map.keyframes[k].centre() - map.keyframes[first + k].centre()).norm()).fold(0.0, f64::max);
        assert!(off < 0.02, "{off} m");
        assert!(map.covisible(newest).iter().any(|(k, shared)| *k < first && *shared > 50));
    }
}

#[test]
fn an_earlier_loop_holds_its_keyframes_as_bundle_adjustment_has_left_them() {
    let config = TrackingConfig::default();
    let mut map = drifted(&Sim3::identity(), true, &config);
    let (newest, rig) = (map.keyframes.len() - 1, Rig::new(PINHOLE, config));
    let mut closer = LoopCloser::default();
    let (a, b) = (STATIONS / 2, STATIONS / 4);
    let measured = se3::exp(&Vector6::new(0.2, 0.0, -0.1, 0.0, 0.02, 0.0)) * station(a) * station(b).inverse();
    let weights = Vector7::repeat(1e3);
    closer.edges.push(Edge { a, b, a_from_b: Sim3::from(measured), weights, huber: None });
    let mut correction = closer.recognise(&mut map, newest, &rig).unwrap();
    correction.solve();
    assert!(!closer.apply(&correction, &mut map, &rig).is_empty());
    let off = off_metres(&map, false);
    assert!(off < 5e-3, "{off} m");
}

#[test]
fn rotations_stay_rotations_through_any_number_of_corrections() {
    let config = TrackingConfig::default();
    let step = sim3::exp(&Vector7::from_column_slice(&[0.004, 0.001, -0.003, 0.001, 0.003, 0.0005, 0.0]));
    let mut map = drifted(&step, true, &config);
    let (newest, rig) = (map.keyframes.len() - 1, Rig::new(PINHOLE, config));
    let mut closer = LoopCloser::default();
    let mut correction = closer.recognise(&mut map, newest, &rig).unwrap();
    correction.solve();
    for _ in 0..200 {
        closer.apply(&correction, &mut map, &rig);
    }
    assert!(
        map.keyframes.iter().all(|k| (k.camera_from_world.rotation.norm() - 1.0).abs() < 1e-12 && k.centre().coords.norm() < 1e3)
    );
}

/// Two submaps of one keyframe each, at the world's origin and at `second`, in front of a wall of the room of [`corner`]; they have `shared` points in
/// common.
fn one_keyframe_each(second: &Se3, shared: usize, pixels: Option<[DenseFrame; 2]>, config: &TrackingConfig) -> Map {
    let mut random = fastrand::Rng::with_seed(3);
    let mut point = || (Point3::new(1.6 * random.f64() - 1.0, 1.2 * random.f64() - 0.6, 3.0), Descriptor([random.u64(..); 4]));
    let wall: Vec<(Point3<f64>, Descriptor)> = (0..shared + 60).map(|_| point()).collect();
    let submap = |pose: &Se3, points: &[(Point3<f64>, Descriptor)], dense: Option<DenseFrame>| {
        let feature = |(p, descriptor): &(Point3<f64>, Descriptor)| {
            let p_in_camera = (pose * p).coords;
            let pixel = PINHOLE.project(&p_in_camera).unwrap();
            let depth_metres = Some(p_in_camera.z);
            Feature { pixel, octave: 2, angle_rad: 0.0, depth_metres, inverse_depth_sigma: 0.025, descriptor: *descriptor }
        };
        let features = Arc::new(FrameFeatures::new(points.iter().map(feature).collect(), &PINHOLE));
        let mut map = Map::default();
        map.push(Keyframe { dense: dense.map(Arc::new), ..Keyframe::new(0, 0.0, Se3::identity(), features) });
        for (feature, (p, _)) in points.iter().enumerate() {
            map.add_landmark(Observation { keyframe: 0, feature }, pose * p, config);
        }
        map
    };
    let [first, again] = pixels.map_or([None, None], |pixels| pixels.map(Some));
    let mut map = submap(&Se3::identity(), &wall[..shared + 30], first);
    let [common, own] = [&wall[..shared], &wall[shared + 30..]];
    map.append(submap(second, &[common, own].concat(), again), &Se3::translation(300.0, 0.0, 0.0), config);
    map
}

#[test]
fn pixels_confirm_a_place_that_no_neighbour_shows() {
    let config = TrackingConfig::default();
    let second = se3::exp(&Vector6::new(0.12, -0.06, 0.1, 0.04, -0.07, 0.05));
    let elsewhere = se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 2.4, 0.0));
    let of = |pose: &Se3| Some([corner(&Se3::identity()), corner(pose)]);
    let joined = |shared, pixels| {
        let mut map = one_keyframe_each(&second, shared, pixels, &config);
        let moved = close(&mut LoopCloser::default(), &mut map, 1, &config);
        (!moved.is_empty()).then(|| se3::log(&(map.keyframes[1].camera_from_world * second.inverse())).norm())
    };
    assert!(joined(40, of(&second)).is_some_and(|off| off < 5e-3));
    assert!(joined(12, of(&second)).is_none(), "too few landmarks");
    assert!(joined(40, of(&elsewhere)).is_none(), "pixels of another place");
    assert!(joined(40, None).is_none(), "neither pixels nor neighbours");
}
