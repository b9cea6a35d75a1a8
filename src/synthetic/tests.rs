//! Whole recordings at a small size: exactness, repeatability, what each fault of the sensor does, and what is refused.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector2};

use super::*;
use crate::sequence::{Frame, Sensor, Sequence};

/// A small room seen by a small camera.
fn small() -> SceneConfig {
    SceneConfig {
        frames: 6,
        fps: 4.0,
        camera: CameraConfig { width: 96, height: 72, fx: 80.0, fy: 80.0, cx: 47.5, cy: 35.5, ..CameraConfig::default() },
        furniture: FurnitureConfig {
            shelves: 1,
            cabinets: 1,
            plants: 1,
            boxes: 1,
            lamps: 1,
            pictures: 4,
            ..FurnitureConfig::default()
        },
        ..SceneConfig::default()
    }
}

fn with(edit: impl Fn(&mut SceneConfig)) -> SceneConfig {
    let mut config = small();
    edit(&mut config);
    config
}

/// Generates a scene and opens it as any recording.
fn record(config: &SceneConfig) -> (tempfile::TempDir, Sequence) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("scene");
    generate(config, &out, &|done, total| assert!(done <= total)).unwrap();
    let sequence = Sequence::open(&out, None, None).unwrap();
    (folder, sequence)
}

fn frames(config: &SceneConfig) -> Vec<Frame> {
    let (_folder, sequence) = record(config);
    (0..sequence.entries.len()).map(|i| sequence.load(i).unwrap()).collect()
}

fn error(edit: impl Fn(&mut SceneConfig)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let text = generate(&with(edit), &folder.path().join("out"), &|_, _| ()).unwrap_err().to_string();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "a refused scene leaves nothing behind");
    text
}

/// Lifts pixels of one frame by their depth and finds them in another, through the lens, by the poses of the truth file.
#[test]
fn depth_of_one_frame_agrees_with_that_of_another() {
    let config = with(|c| (c.camera.k1, c.camera.k2, c.camera.p1, c.camera.p2) = (-0.2, 0.05, 0.002, -0.003));
    let (_folder, sequence) = record(&config);
    let truth = sequence.groundtruth.clone().unwrap();
    assert_eq!(truth.poses.len(), config.frames);
    let camera = sequence.camera;
    let (mut compared, mut agreed) = (0, 0);
    for (i, j) in [(0, 1), (2, 4), (5, 3)] {
        let depth = [i, j].map(|k| sequence.load(k).unwrap().depth.unwrap());
        let j_from_i = truth.poses[j].world_from_camera.inverse() * truth.poses[i].world_from_camera;
        for (x, y) in (0..72).flat_map(|y| (0..96).map(move |x| (x, y))) {
            let ideal = camera.undistort_pixel(&Vector2::new(f64::from(x), f64::from(y)));
            let lifted = camera.pinhole.unproject(&ideal, f64::from(depth[0].at(x, y).unwrap()));
            let moved = (j_from_i * Point3::from(lifted)).coords;
            let Some(pixel) = camera.pinhole.project(&moved).map(|p| camera.distort_pixel(&p)) else { continue };
            if !camera.pinhole.contains(&pixel, 2.0) {
                continue;
            }
            // Depth of a plane is linear in 1/z over the ideal image, and over few pixels nearly so in the recorded one.
            let (u, v) = (pixel.x as u32, pixel.y as u32);
            let at = |u: u32, v: u32| 1.0 / f64::from(depth[1].at(u, v).unwrap());
            let near = [(u, v), (u + 1, v), (u, v + 1), (u + 1, v + 1)].map(|(u, v)| at(u, v));
            let bend = |a: f64, b: f64, c: f64, d: f64| ((a - b) - (c - d)).abs() > 2e-3 * b;
            let bent = |v: u32| bend(at(u - 1, v), at(u, v), at(u + 1, v), at(u + 2, v));
            let bent_down = |u: u32| bend(at(u, v - 1), at(u, v), at(u, v + 1), at(u, v + 2));
            let step = |a: f64, b: f64, c: f64| ((a - b) - (b - c)).abs() > 2e-3 * b;
            let stepped = step(at(u - 1, v), at(u, v), at(u + 1, v)) || step(at(u, v - 1), at(u, v), at(u, v + 1));
            if stepped || bent(v) || bent(v + 1) || bent_down(u) || bent_down(u + 1) {
                continue; // Surfaces meet here.
            }
            let (f, g) = (pixel.x.fract(), pixel.y.fract());
            let expected = (near[0] * (1.0 - f) + near[1] * f) * (1.0 - g) + (near[2] * (1.0 - f) + near[3] * f) * g;
            if moved.z * expected > 1.01 {
                continue; // Hidden from the other frame by something nearer.
            }
            compared += 1;
            agreed += usize::from((moved.z * expected - 1.0).abs() < 5e-4);
        }
    }
    assert!(compared > 5000 && agreed as f64 > 0.985 * compared as f64, "{agreed} of {compared}");
}

#[test]
fn the_same_scene_gives_the_same_bytes_on_any_number_of_threads() {
    let config = with(|c| {
        c.frames = 3;
        c.degradation = DegradationConfig {
            image_noise: 2.0,
            depth_noise: 0.002,
            motion_blur: 0.5,
            exposure_drift: 0.2,
            missing_depth: 0.1,
            moving_object: true,
            ..DegradationConfig::default()
        };
    });
    let [one, three] = [1, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (folder, _) = pool.install(|| record(&config));
        bytes(&folder.path().join("scene"))
    });
    assert_eq!(one.len(), 2 * 3 + 5);
    assert!(one == three);
    let copy: SceneConfig = toml::from_str(&String::from_utf8(one["scene.toml"].clone()).unwrap()).unwrap();
    assert_eq!((&copy, copy.digest()), (&config, config.digest()));
    assert_ne!(with(|c| c.seed = 99).digest(), small().digest());
}

/// Every file below a folder, by its name.
fn bytes(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let name = entry.file_name().to_string_lossy().into_owned();
        if entry.path().is_dir() {
            all.extend(bytes(&entry.path()).into_iter().map(|(file, content)| (format!("{name}/{file}"), content)));
        } else {
            all.insert(name, std::fs::read(entry.path()).unwrap());
        }
    }
    all
}

#[test]
fn noise_has_the_spread_that_was_asked_for() {
    let clean = frames(&small());
    let noisy = frames(&with(|c| (c.degradation.image_noise, c.degradation.depth_noise) = (5.0, 0.003)));
    let (mut color, mut depth) = (Vec::new(), Vec::new());
    for (a, b) in clean.iter().zip(&noisy) {
        let levels = a.color.as_raw().iter().zip(b.color.as_raw());
        // Away from the ends, where clipping would narrow the spread.
        color.extend(levels.filter(|(a, _)| (25..230).contains(*a)).map(|(a, b)| f64::from(*b) - f64::from(*a)));
        let metres = a.depth.as_ref().unwrap().metres.iter().zip(&b.depth.as_ref().unwrap().metres);
        depth.extend(metres.map(|(a, b)| f64::from(b - a) / f64::from(a * a)));
    }
    let spread = |v: &[f64]| (v.iter().map(|x| x * x).sum::<f64>() / v.len() as f64).sqrt();
    assert!((spread(&color) - 5.0).abs() < 0.15, "{}", spread(&color));
    assert!((spread(&depth) - 0.003).abs() < 1e-4, "{}", spread(&depth));
}

#[test]
fn lost_depth_has_the_share_and_the_range_that_were_asked_for() {
    let lost = |config: &SceneConfig| {
        let frames = frames(config);
        let metres: Vec<f32> = frames.into_iter().flat_map(|f| f.depth.unwrap().metres).collect();
        let farthest = metres.iter().copied().fold(0.0, f32::max);
        (metres.iter().filter(|z| **z == 0.0).count() as f64 / metres.len() as f64, farthest)
    };
    assert_eq!(lost(&small()).0, 0.0);
    let (share, _) = lost(&with(|c| c.degradation.missing_depth = 0.2));
    assert!((0.17..0.27).contains(&share), "{share}");
    let (share, farthest) = lost(&with(|c| c.degradation.max_range = 3.0));
    assert!(share > 0.05 && farthest <= 3.0, "{share} lost, up to {farthest} m");
}

#[test]
fn blur_softens_and_drift_changes_brightness() {
    let mean = |f: &Frame| f.color.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>() / f.color.as_raw().len() as f64;
    let detail = |f: &Frame| -> f64 {
        let rows = f.color.as_raw().chunks_exact(96 * 3);
        rows.flat_map(|row| row.windows(4).map(|w| (f64::from(w[3]) - f64::from(w[0])).powi(2))).sum()
    };
    let clean = frames(&small());
    let blurred = frames(&with(|c| c.degradation.motion_blur = 1.0));
    let [sharp, soft] = [&clean, &blurred].map(|frames| frames.iter().map(detail).sum::<f64>());
    assert!(soft < 0.75 * sharp, "{soft} against {sharp}");
    assert!(clean.iter().zip(&blurred).all(|(a, b)| a.depth == b.depth && (mean(a) - mean(b)).abs() < 6.0));
    let drifting = frames(&with(|c| c.degradation.exposure_drift = 0.5));
    let ratios: Vec<f64> = clean.iter().zip(&drifting).map(|(a, b)| mean(b) / mean(a)).collect();
    let (low, high) = ratios.iter().fold((f64::MAX, f64::MIN), |(l, h), r| (l.min(*r), h.max(*r)));
    assert!(high - low > 0.05, "{ratios:?}");
}

#[test]
fn a_covered_lens_sees_nothing_and_a_moving_thing_moves() {
    let covered = frames(&with(|c| c.degradation.covered = Some([2, 4])));
    for (i, frame) in covered.iter().enumerate() {
        let black =
            frame.color.as_raw().iter().all(|v| *v == 0) && frame.depth.as_ref().unwrap().metres.iter().all(|z| *z == 0.0);
        assert_eq!(black, (2..4).contains(&i));
    }
    let clean = frames(&small());
    let moving = frames(&with(|c| c.degradation.moving_object = true));
    let nearer = |(a, b): (&Frame, &Frame)| {
        let pairs = a.depth.as_ref().unwrap().metres.iter().zip(&b.depth.as_ref().unwrap().metres);
        assert!(pairs.clone().all(|(still, moved)| moved <= still), "it can only hide things");
        pairs.filter(|(still, moved)| *moved < *still).count()
    };
    let sizes: Vec<usize> = clean.iter().zip(&moving).map(nearer).collect();
    assert!(sizes.iter().filter(|size| **size > 60).count() >= 3, "{sizes:?}");
}

#[test]
fn every_view_has_texture_and_light() {
    for frame in frames(&small()) {
        let gray: Vec<f64> = frame.color.pixels().map(|p| p.0.iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0).collect();
        let mean = gray.iter().sum::<f64>() / gray.len() as f64;
        assert!((60.0..200.0).contains(&mean), "mean level {mean}");
        // Corners need neighbours that differ: in each of 16 parts of the image, a good part of the pixels has one.
        for (i, j) in (0..4).flat_map(|j| (0..4).map(move |i| (i, j))) {
            let pixels = (0..17).flat_map(|y| (0..23).map(move |x| (j * 18 + y) * 96 + i * 24 + x));
            let strong = pixels.filter(|k| (gray[*k + 1] - gray[*k]).hypot(gray[*k + 96] - gray[*k]) > 8.0).count();
            assert!(strong > 25, "frame {}, part {i},{j}: {strong} of 391", frame.index);
        }
    }
}

/// What the left camera sees at a depth, the right one sees where its baseline puts it; what is written is read as a stereo recording.
#[test]
fn a_stereo_pair_agrees_with_depth_and_calibration() {
    let config = with(|c| c.stereo = Some(StereoConfig { baseline: 0.2, misalignment: 0.0 }));
    let (_folder, sequence) = record(&config);
    let Sensor::Stereo { baseline_metres } = sequence.sensor else { panic!("{:?}", sequence.sensor) };
    assert!((baseline_metres - 0.2).abs() < 1e-12);
    let recording = Recording::new(&config).unwrap();
    let truth = sequence.groundtruth.clone().unwrap();
    assert!(truth.poses.iter().zip(&recording.trajectory().poses).all(|(a, b)| {
        (a.world_from_camera.translation.vector - b.world_from_camera.translation.vector).norm() < 1e-9
            && a.world_from_camera.rotation.angle_to(&b.world_from_camera.rotation) < 1e-7
    }));
    let (mut compared, mut agreed) = (0, 0);
    for k in 0..config.frames {
        let frame = sequence.load(k).unwrap();
        let (left, right) = (image::imageops::grayscale(&frame.color), frame.right.unwrap());
        let geometry = recording.render(k, 0).geometry;
        for (x, y) in (0..72u32).flat_map(|y| (0..96u32).map(move |x| (x, y))) {
            let shifted = f64::from(x) - 80.0 * 0.2 / f64::from(geometry[(y * 96 + x) as usize].depth_metres);
            if shifted < 0.0 {
                continue;
            }
            let (whole, part) = (shifted.floor() as u32, shifted.fract());
            let grey = |x: u32| f64::from(right.get_pixel(x.min(95), y)[0]);
            let seen = grey(whole) + part * (grey(whole + 1) - grey(whole));
            compared += 1;
            agreed += usize::from((seen - f64::from(left.get_pixel(x, y)[0])).abs() < 12.0);
        }
    }
    assert!(compared > 20_000 && agreed * 100 > compared * 85, "{agreed} of {compared}");
}

#[test]
fn a_misaligned_pair_is_turned_by_no_more_than_that_and_by_its_seed() {
    let turned = |seed: u64| {
        let config = with(|c| (c.seed, c.stereo) = (seed, Some(StereoConfig { baseline: 0.2, misalignment: 0.02 })));
        cameras(&config)[1].rotation.scaled_axis() * 1f64.to_degrees()
    };
    assert!((1..20).all(|seed| turned(seed).amax() <= 0.02 && turned(seed).norm() > 0.0));
    assert!(turned(1) != turned(2) && turned(1) == turned(1));
}

#[test]
fn bad_scenes_are_refused_with_the_field_and_what_to_do() {
    assert!(error(|c| c.frames = 0).contains("`frames` is 0"));
    assert!(error(|c| c.camera.fx = f64::NAN).contains("`camera.fx` is NaN"));
    assert!(error(|c| c.room.width = 1.0).contains("`room.width` is 1"));
    assert!(error(|c| c.furniture.sofas = 40).contains("`furniture.sofas`: there is no place"));
    assert!(error(|c| c.furniture.rugs = usize::MAX).contains("`furniture"));
    assert!(error(|c| c.camera.k1 = -1.8).contains("too strong"));
    assert!(error(|c| c.degradation.covered = Some([3, 3])).contains("from < to"));
    assert!(error(|c| c.degradation.covered = Some([3, 300])).contains("<= 6 frames"));
    assert!(error(|c| (c.path.kind, c.path.rounds) = (PathKind::Loop, 2)).contains("give at least"));
    assert!(error(|c| c.stereo = Some(StereoConfig { baseline: -0.1, misalignment: 0.0 })).contains("`stereo.baseline` is -0.1"));
    assert!(error(|c| (c.stereo, c.camera.k1) = (Some(StereoConfig::default()), 0.1)).contains("must be 0 with `stereo`"));
    assert!(error(|c| (c.room.height, c.path.height) = (2.2, 1.9)).contains("`path.height`"));
}

#[test]
fn bad_places_are_refused_and_scene_files_name_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("taken");
    std::fs::create_dir(&out).unwrap();
    std::fs::write(out.join("mine.txt"), "keep").unwrap();
    assert!(generate(&small(), &out, &|_, _| ()).unwrap_err().to_string().contains("is there already"));
    assert!(generate(&small(), &out.join("mine.txt/x"), &|_, _| ()).unwrap_err().to_string().contains("cannot write"));
    let scene = folder.path().join("scene.toml");
    let read = |text: &str| {
        std::fs::write(&scene, text).unwrap();
        SceneConfig::read(&scene).unwrap_err().to_string()
    };
    assert!(read("frames = 0").contains("scene.toml: `frames`"));
    assert!(read("[camera]\nzoom = 2").contains("zoom"));
    assert!(SceneConfig::read(&folder.path().join("none.toml")).unwrap_err().to_string().contains("none.toml"));
}

/// The scenes we ship are valid: furnished, clear of the camera, at a hand's pace.
#[test]
fn shipped_scenes_can_be_built() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("sequences");
    let scenes = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    for scene in scenes.filter(|p| p.file_name().is_some_and(|n| n != "cameras.toml")) {
        let config = SceneConfig::read(&scene).unwrap();
        let plan = Plan::new(&config).unwrap_or_else(|e| panic!("{}: {e}", scene.display()));
        let (mut speed, mut turn) = (0.0f64, 0.0f64);
        for i in 0..config.frames * 4 {
            let [a, b] = [i, i + 1].map(|k| plan.path.world_from_camera(k as f64 / config.fps / 4.0));
            let per_s = config.fps * 4.0;
            speed = speed.max((b.translation.vector - a.translation.vector).norm() * per_s);
            turn = turn.max(a.rotation.angle_to(&b.rotation).to_degrees() * per_s);
        }
        println!("{}: at most {speed:.2} m/s, {turn:.0} degrees/s", scene.display());
        let (most, fastest) = match config.path.kind {
            PathKind::Loop => (0.8, 60.0),
            PathKind::Drive => (4.5, 20.0),
            PathKind::Sweep | PathKind::Walk => (0.5, 40.0),
        };
        assert!(speed < most && turn < fastest, "{}: {speed} m/s, {turn} degrees/s", scene.display());
    }
}

/// Every corner of the exact surface lies on a solid, and the surface is where the camera's own depth is.
#[test]
fn the_exact_surface_is_what_the_camera_measures() {
    let camera = CameraConfig { width: 64, height: 48, fx: 52.5, fy: 52.5, cx: 31.5, cy: 23.5, ..CameraConfig::default() };
    let config = SceneConfig { frames: 12, camera, ..SceneConfig::default() };
    let surface = visible_surface(&config).unwrap();
    let (recording, plan) = (Recording::new(&config).unwrap(), Plan::new(&config).unwrap());
    let near = |p: glam::DVec3| {
        plan.solids.iter().any(|solid| {
            let q = solid.to_local(p);
            // Ellipsoids are measured along the ray to their centre.
            match solid.shape {
                shapes::Shape::Ellipsoid { radii } => (1.0 - (q / radii).length()).abs() * radii.max_element() < 1e-4,
                shapes::Shape::Shell { .. } => solid.distance(p) < 1e-4,
                _ => (solid.distance(p) < 1e-4) && !solid.contains(solid.to_world(q * (1.0 + 1e-3))),
            }
        })
    };
    let off: Vec<glam::Vec3> = surface.vertices.iter().step_by(97).copied().filter(|p| !near(p.as_dvec3())).collect();
    assert!(off.is_empty(), "on no surface: {off:?}");
    let (depth, pose) = (recording.render(6, 0).geometry, recording.path.world_from_camera(recording.time_s(6)));
    let pinhole = config.camera().pinhole;
    let pixels = (0..64 * 48).step_by(61).map(|i| (i, nalgebra::Vector2::new(f64::from(i % 64), f64::from(i / 64))));
    for (i, pixel) in pixels {
        let p = pose * nalgebra::Point3::from(pinhole.unproject(&pixel, f64::from(depth[i as usize].depth_metres)));
        let p = glam::Vec3::new(p.x as f32, p.y as f32, p.z as f32);
        let nearest = surface.vertices.iter().map(|q| q.distance(p)).fold(f32::INFINITY, f32::min);
        assert!(nearest < 0.025, "{p} is {nearest} m from the surface's nearest corner");
    }
}
