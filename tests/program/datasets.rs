//! `keysplat export --format colmap|colmap-text|transforms|kitti`: what a run leaves, read back as recordings with known poses.

use std::path::{Path, PathBuf};

use keysplat::Config;
use keysplat::export::MapFormat;
use keysplat::geometry::{Camera, Se3, Trajectory};
use keysplat::sequence::{Sensor, Sequence};
use keysplat::splat::ShDegree;
use keysplat::synthetic::{self, SceneConfig};
use nalgebra::Matrix4;

use crate::common::recording::{FRAMES, Finished, color_file, finish, keysplat, recording, scene, scratch, truncate};

const GAUSSIANS: usize = 300;
/// Of the run's frames.
const KEYFRAMES: [usize; 3] = [0, 7, 20];

/// The folder of a run that knew the truth.
fn run_of(name: &str, recording: &Path) -> (PathBuf, Sequence) {
    let folder = scratch().join(name);
    std::fs::create_dir_all(&folder).unwrap();
    let map = crate::common::scene(&mut fastrand::Rng::with_seed(4), GAUSSIANS, ShDegree::new(1).unwrap());
    MapFormat::default().write(&map, &folder.join("map.ply")).unwrap();
    let sequence = Sequence::open(recording, None, None).unwrap();
    let truth = sequence.groundtruth.clone().unwrap();
    truth.write_tum(&folder.join("trajectory.txt")).unwrap();
    let keyframes = Trajectory { poses: KEYFRAMES.map(|index| truth.poses[index]).to_vec() };
    keyframes.write_tum(&folder.join("keyframes.txt")).unwrap();
    std::fs::write(folder.join("config.toml"), Config::for_recording(recording).to_toml()).unwrap();
    (folder, sequence)
}

fn export(run: &Path, out: &Path, format: &str, more: &[&str]) -> Finished {
    let mut command = keysplat(["export".as_ref(), run.as_os_str(), out.as_os_str()]);
    command.args(["--format", format]).args(more);
    finish(command)
}

fn pose(sequence: &Sequence, index: usize) -> Se3 {
    sequence.groundtruth.as_ref().unwrap().poses[index].world_from_camera
}

fn close(a: &Se3, b: &Se3) -> bool {
    (a.to_matrix() - b.to_matrix()).abs().max() < 1e-8
}

/// The same lens but for the rounding of half a pixel.
fn same_camera(a: &Camera, b: &Camera) -> bool {
    let numbers = |camera: &Camera| [camera.pinhole.fx, camera.pinhole.fy, camera.pinhole.cx, camera.pinhole.cy];
    let near = numbers(a).iter().zip(numbers(b)).all(|(a, b)| (a - b).abs() < 1e-9);
    near && (a.pinhole.width, a.pinhole.height) == (b.pinhole.width, b.pinhole.height) && b.distortion.is_zero()
}

#[test]
fn other_trainers_get_images_poses_and_points() {
    let (run, sequence) = run_of("run", recording());
    for format in ["colmap", "colmap-text", "transforms"] {
        let out = scratch().join(format);
        let said = export(&run, &out, format, &["--min-opacity", "0"]).succeeded();
        assert!(said.stdout.contains("3 images, 300 points"), "{}", said.stdout);
        let back = Sequence::open(&out, None, None).unwrap();
        assert!(back.layout.name() == format.trim_end_matches("-text") && same_camera(&sequence.camera, &back.camera));
        assert_eq!(back.entries.len(), KEYFRAMES.len());
        for (at, index) in KEYFRAMES.into_iter().enumerate() {
            assert!(close(&pose(&back, at), &pose(&sequence, index)), "{format}: {index}");
            let (frame, recorded) = (back.load(at).unwrap(), sequence.load(index).unwrap());
            assert!(frame.color == recorded.color && frame.mask.is_none());
            let image = back.entries[at].color.file_name().unwrap();
            assert_eq!(image.to_str(), Some(format!("{index:06}.png").as_str()));
            let Some(depth) = frame.depth else { continue };
            let pairs = depth.metres.iter().zip(recorded.depth.unwrap().metres);
            assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 6e-4) && pairs.clone().any(|(a, _)| *a > 0.5));
        }
        if format == "transforms" {
            assert_eq!(back.sensor, Sensor::Rgbd);
            let points = std::fs::read(out.join("points.ply")).unwrap();
            assert!(points.starts_with(b"ply\n") && points.len() > GAUSSIANS * 15);
        } else {
            let map = MapFormat::default().read(&run.join("map.ply")).unwrap();
            assert_eq!(back.points.len(), GAUSSIANS);
            let apart = |i: usize| (back.points[i].position - nalgebra::Vector3::from(map.means[i].to_array()).cast()).norm();
            assert!((0..GAUSSIANS).all(|i| apart(i) < 1e-6));
        }
        export(&run, &out, format, &[]).refused(&["is not empty"]);
    }
    let all = scratch().join("all");
    export(&run, &all.join("transforms.json"), "transforms", &["--views", "all"]).succeeded();
    assert_eq!(Sequence::open(&all, None, None).unwrap().entries.len(), FRAMES);
}

/// Trainers want a pinhole: images are rectified, and what the lens did not see is masked.
#[test]
fn images_of_a_lens_are_rectified_and_masked() {
    let bent = scratch().join("bent");
    let mut config = SceneConfig { frames: 21, ..scene() };
    config.camera.k1 = 0.15;
    synthetic::generate(&config, &bent, &|_, _| {}).unwrap();
    let (run, sequence) = run_of("run-bent", &bent);
    let out = scratch().join("rectified");
    export(&run, &out, "transforms", &[]).succeeded();
    let back = Sequence::open(&out, None, None).unwrap();
    assert!(same_camera(&sequence.camera, &back.camera) && !sequence.camera.distortion.is_zero());
    let frame = back.load(1).unwrap();
    assert_ne!(frame.color, sequence.load(KEYFRAMES[1]).unwrap().color);
    let mask = frame.mask.unwrap();
    let centre = (mask.width() / 2, mask.height() / 2);
    assert_eq!([mask.get_pixel(0, 0).0[0], mask.get_pixel(centre.0, centre.1).0[0]], [0, 255]);
}

#[test]
fn poses_are_written_as_kitti_has_them() {
    let (run, sequence) = run_of("run-kitti", recording());
    let file = scratch().join("poses.kitti");
    export(&run, &file, "kitti", &[]).succeeded();
    let text = std::fs::read_to_string(&file).unwrap();
    assert_eq!(text.lines().count(), FRAMES);
    for (index, line) in text.lines().enumerate() {
        let numbers: Vec<f64> = line.split(' ').map(|number| number.parse().unwrap()).collect();
        let matrix = Matrix4::from_row_iterator(numbers.into_iter().chain([0.0, 0.0, 0.0, 1.0]));
        assert!((matrix - pose(&sequence, index).to_matrix()).abs().max() < 1e-8);
    }
}

#[test]
fn runs_that_cannot_be_handed_on_say_why() {
    let copy = crate::common::recording::copy_of_recording("spoilt");
    let (run, _) = run_of("run-spoilt", &copy);
    truncate(&color_file(&copy, KEYFRAMES[1]), 100);
    let partly = export(&run, &scratch().join("partly"), "colmap", &[]).succeeded();
    assert!(partly.stdout.contains("2 images, 1 left out that cannot be read"), "{}", partly.stdout);
    std::fs::rename(&copy, scratch().join("moved")).unwrap();
    let out = scratch().join("of-moved");
    export(&run, &out, "colmap", &[]).refused(&["spoilt"]);
    let moved = scratch().join("moved");
    export(&run, &out, "colmap", &["--sequence", moved.to_str().unwrap()]).succeeded();
    std::fs::remove_file(run.join("keyframes.txt")).unwrap();
    export(&run, &scratch().join("none"), "colmap", &[]).refused(&["keyframes.txt", "finished run"]);
    std::fs::remove_file(run.join("trajectory.txt")).unwrap();
    export(&run, &scratch().join("none.txt"), "kitti", &[]).refused(&["trajectory.txt"]);
    export(&run, &scratch().join("none.txt"), "xyz", &[]).refused(&["colmap-text"]);
    assert!(!scratch().join("none").exists());
}
