use std::collections::BTreeSet;

use glam::{Quat, Vec3};
use serde_json::Value;

use super::super::board::{History, put};
use super::super::protocol::{CameraPath, Hello, PoseView, Statistics};
use super::*;
use crate::splat::{Gaussian, GaussianCloud, ShDegree};

fn board() -> Board {
    Board::new(Hello {
        protocol: 1,
        name: "room".into(),
        sensor: None,
        live: true,
        control: true,
        exact: true,
        images: true,
        units: "metres",
        camera: None,
        frames: None,
    })
}

fn cloud(gaussians: usize, offset: f32) -> GaussianCloud {
    let mut random = fastrand::Rng::with_seed(8);
    let mut cloud = GaussianCloud::new(ShDegree::new(1).unwrap());
    for _ in 0..gaussians {
        let mean = 20.0 * Vec3::new(random.f32(), random.f32(), random.f32());
        let raw_opacity = if mean.x < 10.0 { offset } else { 0.0 };
        cloud.push(Gaussian { mean, log_scale: Vec3::splat(-3.0), rotation: Quat::IDENTITY, raw_opacity, sh: vec![Vec3::ZERO] });
    }
    cloud
}

fn header(message: &Outgoing) -> Value {
    match message {
        Outgoing::Text(text) => serde_json::from_str(text).unwrap(),
        Outgoing::Binary(bytes) => {
            let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
            serde_json::from_slice(&bytes[4..4 + length]).unwrap()
        }
    }
}

/// The parts of a `map` message.
fn parts(header: &Value) -> BTreeSet<String> {
    header["chunks"].as_array().unwrap().iter().map(|chunk| format!("{} {}", chunk["at"], chunk["part"])).collect()
}

#[test]
fn a_map_arrives_in_bounded_messages_whatever_the_speed() {
    let board = board();
    let map = PackedMap::new(&cloud(60_000, 1.0), 1, None);
    let all = map.parts.len();
    put(&board.map, map);
    let mut delivery = Delivery::default();
    let (mut seen, mut messages) = (BTreeSet::new(), 0);
    while let Some(message) = delivery.next(&board) {
        messages += 1;
        assert!(message.len() <= MOST_TO_VIEWER && delivery.next(&board).is_none(), "the next one waits for the answer");
        let header = header(&message);
        assert_eq!(header["reset"], messages == 1);
        let new = parts(&header);
        assert!(!new.is_empty() && seen.is_disjoint(&new));
        seen.extend(new);
        assert_eq!((header["complete"] == true, delivery.has_all_of(1)), (seen.len() == all, false));
        delivery.sent(message.len(), SLOW * 2);
        delivery.taken(7);
        assert!(delivery.next(&board).is_none());
        delivery.taken(1);
    }
    assert!(seen.len() == all && delivery.has_all_of(1));
    assert!(messages > all / 4, "{messages} messages: a slow connection has small ones");
    let mut quick = Delivery::default();
    for _ in 0..9 {
        quick.sent(MOST_TO_VIEWER, Duration::ZERO);
    }
    assert!(quick.next(&board).unwrap().len() > MOST_TO_VIEWER / 2);
}

#[test]
fn only_what_differs_is_sent_and_the_longest_unsent_first() {
    let board = board();
    let first = PackedMap::new(&cloud(60_000, 1.0), 1, None);
    let mut delivery = Delivery { bytes: MOST_TO_VIEWER, ..Delivery::default() };
    put(&board.map, first.clone());
    delivery.next(&board).unwrap();
    delivery.taken(1);
    let second = PackedMap::new(&cloud(60_000, 2.0), 2, Some(&first));
    let changed = second.parts.iter().filter(|part| first.parts.iter().all(|old| old.digest != part.digest)).count();
    assert!(0 < changed && changed < second.parts.len());
    delivery.bytes = LEAST_BYTES;
    put(&board.map, second.clone());
    let mut order = Vec::new();
    for revision in 2..4 {
        // The third snapshot changes the same parts again: those that the second brought come last.
        let message = delivery.next(&board).unwrap();
        delivery.taken(revision);
        order.push(parts(&header(&message)));
        put(&board.map, PackedMap::new(&cloud(60_000, 3.0), revision + 1, Some(&second)));
    }
    assert!(order[0].is_disjoint(&order[1]));
    let mut rest = BTreeSet::new();
    while let Some(message) = delivery.next(&board) {
        rest.extend(parts(&header(&message)));
        delivery.taken(4);
    }
    assert!(order[0].is_subset(&rest) && delivery.has_all_of(4));
}

#[test]
fn parts_that_are_gone_are_removed() {
    let board = board();
    let first = PackedMap::new(&cloud(2000, 1.0), 1, None);
    put(&board.map, first.clone());
    let mut delivery = Delivery::default();
    delivery.next(&board).unwrap();
    delivery.taken(1);
    let mut smaller = first.clone();
    smaller.revision = 2;
    let gone = smaller.parts.remove(3);
    put(&board.map, smaller);
    let header = header(&delivery.next(&board).unwrap());
    let chunks = header["chunks"].as_array().unwrap();
    assert!(chunks.len() == 1 && chunks[0]["count"] == 0 && chunks[0]["at"] == serde_json::json!(gone.id.at));
    delivery.taken(2);
    put(&board.map, PackedMap { revision: 3, width: first.width + 1, ..first });
    assert_eq!(super::tests::header(&delivery.next(&board).unwrap())["reset"], true, "another grid");
}

#[test]
fn poses_come_once_and_again_where_they_moved() {
    let board = board();
    let view = |id: usize, x: f64| KeyframeView {
        id,
        frame: 2 * id,
        t: 0.1,
        pose: PoseView { p: [x, 0.0, 0.0], q: [0.0, 0.0, 0.0, 1.0] },
    };
    let show =
        |keyframes: Vec<KeyframeView>, loops: Vec<[usize; 2]>| put(&board.frames, Frames { keyframes, loops, current: None });
    let mut delivery = Delivery::default();
    let mut next = || delivery.next(&board).map(|message| header(&message));
    assert!(next().is_none());
    show(vec![view(0, 0.0), view(1, 1.0)], Vec::new());
    let first = next().unwrap();
    assert_eq!((first["all"].as_bool(), first["keyframes"].as_array().unwrap().len()), (Some(true), 2));
    assert!(next().is_none());
    show(vec![view(0, 0.0), view(1, 1.5), view(2, 2.0)], vec![[2, 0]]);
    let moved = next().unwrap();
    let ids: Vec<_> = moved["keyframes"].as_array().unwrap().iter().map(|k| k["id"].as_u64().unwrap()).collect();
    assert_eq!((moved["all"].as_bool(), ids, &moved["loops"]), (Some(false), vec![1, 2], &serde_json::json!([[2, 0]])));
    show(vec![view(0, 0.0), view(3, 3.0), view(4, 4.0)], vec![[2, 0]]);
    let replaced = next().unwrap();
    assert_eq!((replaced["all"].as_bool(), replaced["keyframes"].as_array().unwrap().len()), (Some(true), 3));
    show((0..MOST_KEYFRAMES + 5).map(|id| view(id, 9.0)).collect(), Vec::new());
    assert_eq!(next().unwrap()["keyframes"].as_array().unwrap().len(), MOST_KEYFRAMES);
    assert_eq!(next().unwrap()["keyframes"].as_array().unwrap().len(), 5);
    assert!(next().is_none());
}

#[test]
fn the_newest_image_path_and_statistics_are_sent_once() {
    let board = board();
    let mut delivery = Delivery::default();
    let image = |number| super::super::board::NumberedImage { number, message: Outgoing::Text(format!("{number}")) };
    put(&board.image, image(1));
    assert!(delivery.next(&board).is_none(), "images are for those who want them");
    delivery.wants_images = true;
    put(&board.image, image(2));
    assert_eq!(delivery.next(&board), Some(Outgoing::Text("2".into())));
    assert!(delivery.next(&board).is_none());
    put(&board.path, CameraPath { poses: vec![(0.0, 1.0, 2.0, 3.0, None)], truth: Vec::new() });
    assert_eq!(header(&delivery.next(&board).unwrap())["poses"], serde_json::json!([[0.0, 1.0, 2.0, 3.0, null]]));
    let mut history = History::default();
    history.push(Statistics::default());
    board.statistics.store(Arc::new(history.clone()));
    assert_eq!(header(&delivery.next(&board).unwrap())["entries"].as_array().unwrap().len(), 1);
    history.push(Statistics::default());
    board.statistics.store(Arc::new(history));
    assert_eq!(header(&delivery.next(&board).unwrap())["entries"].as_array().unwrap().len(), 1);
    assert!(delivery.next(&board).is_none());
}
