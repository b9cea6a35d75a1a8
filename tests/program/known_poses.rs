//! Mapping by known poses: of a recording with ground truth, and of photos with COLMAP's model in whatever unit its world has.

use std::path::{Path, PathBuf};

use crate::common::recording::{
    FRAMES, copy_of_recording, finish, metrics, recording, run_command, scratch, skipped_without_adapter, stamps,
};
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

#[test]
fn recordings_without_poses_or_without_a_seed_say_so() {
    let out = scratch().join("refused");
    let bare = copy_of_recording("without-truth");
    std::fs::remove_file(bare.join("groundtruth.txt")).unwrap();
    finish(run_command(&bare, &out, &REFINE)).refused(&["without-truth", "no pose within 0.02 s", "--known-poses"]);
    let mono = finish(run_command(recording(), &out, &[&REFINE[..], &["--sensor", "mono"]].concat()));
    mono.refused(&["neither depth nor points", "points3D"]);
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
