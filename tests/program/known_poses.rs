//! Mapping by known poses: of a recording with ground truth, and of photos with COLMAP's model in whatever unit its world has.

use std::path::{Path, PathBuf};

use crate::common::recording::{
    FRAMES, HEIGHT, WIDTH, copy_of_recording, finish, keysplat, metrics, recording, run_command, scratch,
    skipped_without_adapter, stamps,
};
use image::imageops::{FilterType, resize};
use image::{GrayImage, ImageBuffer, Luma, Rgb};
use keysplat::sequence::Sequence;
use nalgebra::Vector2;

/// Few steps: the map need not be good, only honest.
const STEPS: u64 = 40;
const REFINE: [&str; 5] = ["--known-poses", "--set", "mapping.refine.steps=40", "--set", "mapping.refine.density_every=20"];

fn run(name: &str, recording: &Path) -> PathBuf {
    let out = scratch().join(name);
    finish(run_command(recording, &out, &REFINE)).succeeded();
    out
}

/// The recording as photos with a model by COLMAP, whose world's unit is `1 / units_per_metre` metres: every 6th pixel of every 8th
/// frame is a point.
fn colmap(name: &str, units_per_metre: f64) -> PathBuf {
    let sequence = Sequence::open(recording(), None, None).unwrap();
    let folder = scratch().join(name);
    let model = folder.join("sparse/0");
    [&model, &folder.join("images")].into_iter().for_each(|folder| std::fs::create_dir_all(folder).unwrap());
    let p = sequence.camera.pinhole;
    let camera = format!("1 PINHOLE {} {} {} {} {} {}\n", p.width, p.height, p.fx, p.fy, p.cx + 0.5, p.cy + 0.5);
    let (mut images, mut points) = (String::new(), String::new());
    for index in 0..FRAMES {
        let frame = sequence.load(index).unwrap();
        frame.color.save(folder.join(format!("images/{index:03}.png"))).unwrap();
        let world_from_camera = sequence.groundtruth.as_ref().unwrap().poses[index].world_from_camera;
        let camera_from_world = world_from_camera.inverse();
        let (t, q) = (camera_from_world.translation.vector * units_per_metre, camera_from_world.rotation);
        images += &format!("{index} {} {} {} {} {} {} {} 1 {index:03}.png\n\n", q.w, q.i, q.j, q.k, t.x, t.y, t.z);
        let pixels = (0..p.height).step_by(6).flat_map(|y| (0..p.width).step_by(6).map(move |x| (x, y)));
        for (x, y) in pixels.filter(|_| index % 8 == 0) {
            let Some(metres) = frame.depth.as_ref().unwrap().at(x, y) else { continue };
            let p_in_camera = p.unproject(&Vector2::new(f64::from(x), f64::from(y)), f64::from(metres));
            let at = (world_from_camera * nalgebra::Point3::from(p_in_camera)).coords * units_per_metre;
            let [r, g, b] = frame.color.get_pixel(x, y).0;
            points += &format!("1 {} {} {} {r} {g} {b} 0.5\n", at.x, at.y, at.z);
        }
    }
    [("cameras", camera), ("images", images), ("points3D", points)]
        .into_iter()
        .for_each(|(part, text)| std::fs::write(model.join(format!("{part}.txt")), text).unwrap());
    folder
}

#[test]
fn poses_of_the_truth_make_a_map_that_repeats() {
    if skipped_without_adapter() {
        return;
    }
    let (out, again) = (run("truth", recording()), run("truth-again", recording()));
    let m = metrics(&out);
    assert_eq!(stamps(&out.join("trajectory.txt")).len(), FRAMES, "held-out frames have poses, too");
    assert!(m.ate_rmse_m.all_frames.unwrap() < 1e-6, "{m}");
    let keyframes = m.keyframes.unwrap();
    assert!((2..FRAMES as u64).contains(&keyframes), "a frame that hardly moved is no keyframe: {m}");
    assert!(m.mapping.unwrap().iterations >= STEPS && m.images.held_out.unwrap().psnr_db.unwrap() > 19.0, "{m}");
    assert_eq!(m.map_hash, metrics(&again).map_hash);
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    assert!(config.contains("known_poses = true"), "{config}");
}

#[test]
fn photos_are_mapped_from_points_whatever_their_unit() {
    if skipped_without_adapter() {
        return;
    }
    let psnr = [0.5, 20.0].map(|units_per_metre| {
        let photos = colmap(&format!("photos-{units_per_metre}"), units_per_metre);
        let m = metrics(&run(&format!("of-photos-{units_per_metre}"), &photos));
        // Every 8th is held out.
        assert_eq!((m.keyframes, m.frames_tracked), (Some(FRAMES as u64 - 3), FRAMES as u64), "{m}");
        m.images.held_out.unwrap().psnr_db.unwrap()
    });
    // Cubes of points are powers of two of the unit, so the two maps begin with a tenth more or fewer points.
    assert!(psnr[0] > 24.0 && (psnr[0] - psnr[1]).abs() < 1.0, "{psnr:?}");
}

/// A map given back begins better than points do, and its first steps cost nothing.
#[test]
fn an_exported_map_given_back_begins_better_than_points() {
    let photos = colmap("given-back", 1.0);
    let few = |name: &str, more: &[&str]| {
        let out = scratch().join(name);
        let options = ["--known-poses", "--set", "mapping.refine.steps=2", "--set", "mapping.refine.density_every=20"];
        finish(run_command(&photos, &out, &[&options, more].concat()))
    };
    let damaged = scratch().join("damaged.sog");
    std::fs::write(&damaged, b"PK and no more").unwrap();
    let tracked = ["--set", "initial_map=x.ply"];
    finish(run_command(&photos, &scratch().join("tracked"), &tracked)).refused(&["known poses"]);
    if skipped_without_adapter() {
        return;
    }
    few("of-damage", &["--initial-map", damaged.to_str().unwrap()]).refused(&["initial map", "damaged.sog", "no whole zip"]);
    few("of-nothing", &["--initial-map", "nothing.ply"]).refused(&["nothing.ply"]);
    let psnr = |out: &Path| metrics(out).images.held_out.unwrap().psnr_db.unwrap();
    let first = run("given", &photos);
    finish(run_command(&photos, &first, &[&REFINE[..], &["--initial-map", first.to_str().unwrap()]].concat())).refused(&[
        "given",
        "would be replaced",
        "another --out",
    ]);
    assert!(first.join("map.ply").is_file());
    let unsaid = ["--known-poses", "--format", "glb", "--set", "mapping.antialiased=true"];
    finish(run_command(&photos, &scratch().join("unsaid"), &unsaid)).refused(&["glb", "antialiased"]);
    few("from-points", &[]).succeeded();
    let from_points = psnr(&scratch().join("from-points"));
    for format in ["ply", "spz", "sog"] {
        let map = scratch().join("given").with_extension(format);
        finish(keysplat(["export".as_ref(), first.as_os_str(), map.as_os_str()])).succeeded();
        let name = format!("from-{format}");
        few(&name, &["--initial-map", map.to_str().unwrap()]).succeeded();
        let from_map = psnr(&scratch().join(name));
        let own = psnr(&first);
        assert!(from_map > from_points && from_map > own - 0.3, "{format}: {from_map}, from points {from_points}, its own {own}");
    }
}

/// The photos of [`colmap`], every second one at half its size with a camera of its own.
#[test]
fn photos_of_several_cameras_are_mapped_and_not_tracked() {
    let photos = colmap("cameras", 1.0);
    let model = photos.join("sparse/0");
    let p = Sequence::open(recording(), None, None).unwrap().camera.pinhole.scaled(0.5);
    let mut cameras = std::fs::read_to_string(model.join("cameras.txt")).unwrap();
    cameras += &format!("2 PINHOLE {} {} {} {} {} {}\n", p.width, p.height, p.fx, p.fy, p.cx + 0.5, p.cy + 0.5);
    let mut images = std::fs::read_to_string(model.join("images.txt")).unwrap();
    for index in (1..FRAMES).step_by(2) {
        let photo = photos.join(format!("images/{index:03}.png"));
        let half = resize(&image::open(&photo).unwrap().into_rgb8(), p.width, p.height, FilterType::Triangle);
        half.save(photo).unwrap();
        images = images.replace(&format!(" 1 {index:03}.png"), &format!(" 2 {index:03}.png"));
    }
    std::fs::write(model.join("cameras.txt"), cameras).unwrap();
    std::fs::write(model.join("images.txt"), images).unwrap();
    let tracked = finish(run_command(&photos, &scratch().join("not-tracked"), &[]));
    tracked.refused(&["different cameras", "--known-poses"]);
    if skipped_without_adapter() {
        return;
    }
    let m = metrics(&run("of-cameras", &photos));
    assert_eq!((m.keyframes, m.frames_tracked), (Some(FRAMES as u64 - 3), FRAMES as u64), "{m}");
    assert!(m.images.all_frames.unwrap().psnr_db.unwrap() > 22.0, "{m}");
}

/// Points of the photos themselves come near to those of the model, which are exact here and show most in so few steps.
#[test]
fn a_scene_without_points_begins_from_its_photos() {
    if skipped_without_adapter() {
        return;
    }
    let photos = colmap("without-points", 3.0);
    let psnr = |name: &str| metrics(&run(name, &photos)).images.held_out.unwrap().psnr_db.unwrap();
    let with = psnr("of-points");
    std::fs::remove_file(photos.join("sparse/0/points3D.txt")).unwrap();
    let without = psnr("of-no-points");
    assert!(without > with - 2.0, "{without} dB without, {with} dB with points");
    for index in 0..FRAMES {
        image::RgbImage::new(WIDTH, HEIGHT).save(photos.join(format!("images/{index:03}.png"))).unwrap();
    }
    let blank = finish(run_command(&photos, &scratch().join("of-blank"), &REFINE));
    blank.refused(&["only 0 points could be triangulated", "without-points", "points3D.bin"]);
}

/// The recording as nerfstudio's photos with depth in millimetres and masks, which hide a square that is not of the scene.
fn transforms(name: &str) -> PathBuf {
    let sequence = Sequence::open(recording(), None, None).unwrap();
    let folder = scratch().join(name);
    ["images", "depth", "masks"].iter().for_each(|part| std::fs::create_dir_all(folder.join(part)).unwrap());
    let p = sequence.camera.pinhole;
    let mut frames = Vec::new();
    for index in 0..FRAMES {
        let mut frame = sequence.load(index).unwrap();
        let hidden = |x: u32, y: u32| (40..80).contains(&x) && (30..70).contains(&y);
        let white = frame.color.enumerate_pixels_mut().filter(|(x, y, _)| hidden(*x, *y));
        white.for_each(|(.., pixel)| *pixel = Rgb([255; 3]));
        let file = |part: &str| folder.join(format!("{part}/{index:03}.png"));
        frame.color.save(file("images")).unwrap();
        let depth = frame.depth.unwrap();
        let millimetres = |x, y| Luma([depth.at(x, y).map_or(0, |metres| (metres * 1000.0).round() as u16)]);
        ImageBuffer::from_fn(WIDTH, HEIGHT, millimetres).save(file("depth")).unwrap();
        GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([if hidden(x, y) { 0 } else { 255 }])).save(file("masks")).unwrap();
        let mut pose = sequence.groundtruth.as_ref().unwrap().poses[index].world_from_camera.to_matrix();
        // OpenGL's camera looks along -z, with y up.
        pose.columns_mut(1, 2).neg_mut();
        let rows: Vec<Vec<f64>> = pose.row_iter().map(|row| row.iter().copied().collect()).collect();
        frames.push(format!(
            r#"{{ "file_path": "images/{index:03}.png", "mask_path": "masks/{index:03}.png",
                 "depth_file_path": "depth/{index:03}.png", "transform_matrix": {rows:?} }}"#
        ));
    }
    let lens = format!(r#""fl_x": {}, "fl_y": {}, "cx": {}, "cy": {}"#, p.fx, p.fy, p.cx + 0.5, p.cy + 0.5);
    let text = format!("{{ {lens}, \"frames\": [{}] }}", frames.join(",\n"));
    std::fs::write(folder.join("transforms.json"), text).unwrap();
    folder
}

#[test]
fn masked_pixels_are_neither_mapped_nor_measured() {
    if skipped_without_adapter() {
        return;
    }
    let photos = transforms("masked");
    let m = metrics(&run("of-masked", &photos));
    let held_out = m.images.held_out.unwrap();
    assert!(held_out.psnr_db.unwrap() > 22.0 && held_out.depth_l1_m.unwrap() < 0.1, "{m}");
    let text = std::fs::read_to_string(photos.join("transforms.json")).unwrap();
    std::fs::write(photos.join("transforms.json"), text.replace("mask_path", "no_mask_path")).unwrap();
    let unmasked = metrics(&run("of-unmasked", &photos)).images.held_out.unwrap();
    assert!(unmasked.psnr_db.unwrap() < held_out.psnr_db.unwrap() - 1.0, "the square moves with the camera: {unmasked:?}");
}

#[test]
fn recordings_without_poses_say_so() {
    let out = scratch().join("refused");
    let bare = copy_of_recording("without-truth");
    std::fs::remove_file(bare.join("groundtruth.txt")).unwrap();
    finish(run_command(&bare, &out, &REFINE)).refused(&["without-truth", "no pose within 0.02 s", "--known-poses"]);
    assert!(!out.exists(), "nothing was begun");
}

#[test]
fn frames_without_a_pose_are_lost() {
    if skipped_without_adapter() {
        return;
    }
    let partly = copy_of_recording("partly-known");
    let truth = partly.join("groundtruth.txt");
    let text = std::fs::read_to_string(&truth).unwrap();
    let kept: Vec<&str> = text
        .lines()
        .filter(|line| line.starts_with('#'))
        .chain(text.lines().rev().take(9).collect::<Vec<_>>().into_iter().rev())
        .collect();
    std::fs::write(&truth, kept.join("\n") + "\n").unwrap();
    let m = metrics(&run("of-partly-known", &partly));
    assert_eq!(m.frames_tracked, 9, "{m}");
}
