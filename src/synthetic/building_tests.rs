//! Buildings of several rooms at a small size: the walk, what hides what, and what is refused.

use glam::DVec3;

use super::room::{MIN_CLEARANCE, position};
use super::shapes::Shape;
use super::*;

/// Two by two rooms and a walk through them, seen by a tiny camera.
fn building() -> SceneConfig {
    let defaults = SceneConfig::default();
    SceneConfig {
        frames: 480,
        fps: 8.0,
        camera: CameraConfig { width: 32, height: 24, fx: 26.0, fy: 26.0, cx: 15.5, cy: 11.5, ..CameraConfig::default() },
        room: RoomConfig { width: 5.4, depth: 5.0, rooms: [2, 2], ..RoomConfig::default() },
        furniture: FurnitureConfig { tables: 1, shelves: 1, plants: 1, pictures: 3, rugs: 1, ..FurnitureConfig::NONE },
        path: PathConfig { kind: PathKind::Walk, speed: 0.9, turn_rate: 60.0, ..defaults.path.clone() },
        ..defaults
    }
}

fn error(edit: impl Fn(&mut SceneConfig)) -> String {
    let mut config = building();
    edit(&mut config);
    generate(&config, Path::new("never-written"), &|_, _| ()).unwrap_err().to_string()
}

/// Column and row of a point between the walls, from the sizes alone; `None` within a wall.
fn cell(config: &SceneConfig, p: DVec3) -> Option<(usize, usize)> {
    let along = |at: f64, size: f64, count: usize| {
        let index = (0..count).find(|k| (0.0..=size).contains(&(at - *k as f64 * (size + 0.15))));
        index.filter(|_| (0.0..=config.room.height).contains(&p.z))
    };
    Some((along(p.x, config.room.width, config.room.rooms[0])?, along(p.y, config.room.depth, config.room.rooms[1])?))
}

/// Cells in the order in which a walk enters them; it touches nothing.
fn visited(config: &SceneConfig) -> Vec<(usize, usize)> {
    let plan = Plan::new(config).unwrap();
    let mut visited = Vec::new();
    for frame in 0..config.frames {
        let p = position(&plan.path.world_from_camera(frame as f64 / config.fps));
        let nearest = plan.solids.iter().map(|solid| solid.distance(p)).fold(f64::INFINITY, f64::min);
        assert!(nearest >= MIN_CLEARANCE, "frame {frame}: {nearest} m");
        if let Some(cell) = cell(config, p).filter(|cell| visited.last() != Some(cell)) {
            visited.push(cell);
        }
    }
    visited
}

#[test]
fn a_walk_visits_each_room_in_turn() {
    assert_eq!(visited(&building()), [(0, 0), (1, 0), (1, 1), (0, 1)]);
}

#[test]
fn a_walk_that_returns_goes_back_to_where_the_row_before_began() {
    let mut config = SceneConfig { frames: 1300, ..building() };
    (config.path.returns, config.room.rooms) = (true, [2, 3]);
    let chain = [(0, 0), (1, 0), (1, 1), (0, 1)];
    assert_eq!(visited(&config), [&chain[..], &[(0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 2)]].concat());
    // It sees the rooms beyond the further doorways, too.
    let rooms = Plan::new(&config).unwrap().rooms;
    let looking = |room: usize, from: DVec3, to: DVec3| {
        let ahead = (to - from).normalize();
        let right = ahead.cross(DVec3::Z).normalize();
        rooms.plan.seen_from(from, &glam::DMat3::from_cols(right, ahead.cross(right), ahead)).contains(&room)
    };
    let door = rooms.plan.door(3, 0).unwrap().middle() + DVec3::Z;
    let out = rooms.plan.door(3, 0).unwrap().out_of(3);
    assert!(looking(0, door - out * 2.0, door) && looking(3, door + out * 2.0, door));
    assert!(!looking(0, door - out * 2.0, door - out * 3.0) && !looking(5, door - out * 2.0, door));
    assert!(rooms.plan.joined(0, 3) && !rooms.plan.joined(0, 2) && !rooms.plan.joined(1, 4));
}

#[test]
fn a_walk_is_smooth_and_looks_round_in_each_room() {
    let mut config = building();
    (config.path.shake_metres, config.path.shake_degrees) = (0.0, 0.0);
    let path = CameraPath::new(&config).unwrap();
    let step_s = 0.02;
    let poses: Vec<Se3> =
        (0..(479.0 / config.fps / step_s) as usize).map(|k| path.world_from_camera(k as f64 * step_s)).collect();
    let mut directions = [[false; 8]; 4];
    for pair in poses.windows(2) {
        assert!((pair[1].translation.vector - pair[0].translation.vector).norm() <= config.path.speed * step_s * 1.01);
        assert!(pair[0].rotation.angle_to(&pair[1].rotation).to_degrees() <= config.path.turn_rate * step_s * 1.01);
        let ahead = pair[0].rotation * nalgebra::Vector3::z();
        let eighth = (ahead.y.atan2(ahead.x).to_degrees() / 45.0).rem_euclid(8.0) as usize;
        if let Some((column, row)) = cell(&config, position(&pair[0])) {
            directions[2 * row + column][eighth.min(7)] = true;
        }
    }
    assert_eq!(directions, [[true; 8]; 4]);
}

/// Between the camera and what a pixel shows, walls are crossed in doorways only.
#[test]
fn nothing_is_seen_through_a_wall() {
    let config = building();
    let recording = Recording::new(&config).unwrap();
    let (pinhole, size) = (config.camera().pinhole, [config.room.width, config.room.depth]);
    let (mut within, mut through) = (0, 0);
    for frame in (0..config.frames).step_by(5) {
        let pose = recording.path.world_from_camera(recording.time_s(frame));
        let eye = position(&pose);
        for (i, geometry) in recording.render(frame, 0).geometry.iter().enumerate() {
            let pixel = nalgebra::Vector2::new((i % 32) as f64, (i / 32) as f64);
            let depth_metres = f64::from(geometry.depth_metres);
            assert!((0.3..16.0).contains(&depth_metres), "frame {frame}, {pixel}: {depth_metres} m");
            let p = (pose * nalgebra::Point3::from(pinhole.unproject(&pixel, depth_metres))).coords;
            let p = DVec3::new(p.x, p.y, p.z);
            // The one inner wall along each axis.
            let crossed = [0, 1].into_iter().filter(|axis| {
                let middle = size[*axis] + 0.075;
                (eye[*axis] - middle) * (p[*axis] - middle) < 0.0 && (p[*axis] - middle).abs() > 0.08
            });
            let crossed: Vec<DVec3> =
                crossed.map(|axis| eye.lerp(p, (size[axis] + 0.075 - eye[axis]) / (p[axis] - eye[axis]))).collect();
            (within, through) = (within + usize::from(crossed.is_empty()), through + crossed.len());
            for q in crossed {
                let doors = &recording.renderer.rooms().plan.doors;
                let open = doors.iter().any(|d| q.cmpge(d.low - 1e-3).all() && q.cmple(d.high + 1e-3).all());
                assert!(open, "frame {frame}, {pixel}: {p} is seen from {eye} through the wall at {q}");
            }
        }
    }
    assert!(within > 50_000 && through > 500, "{within} pixels within the room, {through} through doorways");
}

#[test]
fn rooms_differ_and_are_lit() {
    let config = building();
    let recording = Recording::new(&config).unwrap();
    let means: Vec<Vec3> =
        [60, 180, 300, 420].map(|frame| recording.render(frame, 0).color.iter().sum::<Vec3>() / (32.0 * 24.0)).to_vec();
    assert!(means.iter().all(|mean| (0.08..0.9).contains(&(mean.element_sum() / 3.0))), "{means:?}");
    let plan = Plan::new(&config).unwrap();
    let (rooms, mut looks) = (&plan.rooms, std::collections::BTreeSet::new());
    for room in 0..4 {
        let own = rooms.solids(&[room].into());
        assert!(own.len() > 50);
        looks.insert(own.iter().map(|k| plan.solids[*k as usize].seed).collect::<Vec<_>>());
    }
    assert_eq!(looks.len(), 4);
}

#[test]
fn the_exact_surface_of_a_building_lies_on_its_solids_in_all_rooms() {
    let config = SceneConfig { frames: 480, furniture: FurnitureConfig::NONE, ..building() };
    let (surface, plan) = (visible_surface(&config).unwrap(), Plan::new(&config).unwrap());
    let mut rooms = std::collections::BTreeSet::new();
    for p in surface.vertices.iter().step_by(53).map(|p| p.as_dvec3()) {
        let blocks = plan.solids.iter().filter(|solid| matches!(solid.shape, Shape::Block { .. }));
        assert!(blocks.map(|solid| solid.distance(p)).fold(f64::INFINITY, f64::min) < 1e-4, "{p}");
        rooms.extend(cell(&config, p));
    }
    assert_eq!(rooms.len(), 4);
}

/// What was rendered before there were buildings keeps its name, so that nothing is rendered anew.
#[test]
fn a_lone_room_keeps_its_digest() {
    let text = "seed = 8\nframes = 12\nfps = 4.0\n\
        [camera]\nwidth = 160\nheight = 120\nfx = 131.0\nfy = 131.0\ncx = 79.5\ncy = 59.5\n\
        [room]\ngloss = 0.5\n\
        [path]\nkind = \"loop\"\nspeed = 3.0\nturn_rate = 300.0\n\
        [degradation]\nimage_noise = 1.0\nmoving_object = true\n";
    let config = SceneConfig::parse(text, Path::new("scene.toml")).unwrap();
    assert_eq!(config.digest(), "07f2c25e424cba39a036b7a0c3721211dc4a7a670fa98e1488bf65ac81c4dbe9");
    assert!(!config.to_toml().contains("rooms") && building().to_toml().contains("rooms = [2, 2]"));
}

#[test]
fn bad_buildings_are_refused_with_the_field_and_what_to_do() {
    assert!(error(|c| c.room.rooms = [0, 3]).contains("`room.rooms` is [0, 3]"));
    assert!(error(|c| c.room.rooms = [usize::MAX, 2]).contains("1 to 100 in all"));
    assert!(error(|c| c.path.kind = PathKind::Loop).contains("`path.kind` must be \"walk\""));
    assert!(error(|c| (c.path.returns, c.room.rooms) = (true, [1, 4])).contains("`path.returns` must be false"));
    assert!(error(|c| c.furniture.windows = 1).contains("`furniture.windows` must be 0"));
    assert!(error(|c| c.degradation.moving_object = true).contains("`degradation.moving_object` must be false"));
    assert!(error(|c| (c.room.rooms, c.furniture.pictures) = ([10, 10], 60)).contains("between 0 and 40"));
    let text = error(|c| c.frames = 40);
    assert!(text.contains("too few for 4 rooms") && text.contains("give at least"), "{text}");
}
