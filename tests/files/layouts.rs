//! Real recordings in their layouts, skipped where `KEYSPLAT_DATA` names no folder with them; and a video through the whole program.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::common::recording::{
    finish, keysplat, metrics, run_command, scene, scratch, skipped_without_adapter, stamps, truncate,
};
use crate::common::requirements::recorded;
use image::RgbImage;
use keysplat::config::Config;
use keysplat::geometry::Se3;
use keysplat::sequence::{Layout, Sensor, Sequence};
use keysplat::synthetic::{self, CameraConfig, SceneConfig};
use nalgebra::Point3;
use opencv::core::{Mat, MatTraitConst, Size};
use opencv::videoio::{VideoWriter, VideoWriterTrait};

/// Pixels in which only the nearest point is taken for visible.
const CELL: f64 = 16.0;

/// The median difference in colour (0 to 765) between a photo and the known points that a camera at `world_from_camera` would see.
fn median_difference(sequence: &Sequence, world_from_camera: Se3, photo: &RgbImage) -> u32 {
    let camera_from_world = world_from_camera.inverse();
    let mut nearest = BTreeMap::new();
    for point in &sequence.points {
        let p_in_camera = camera_from_world * Point3::from(point.position);
        let pixel = sequence.camera.pinhole.project(&p_in_camera.coords);
        if let Some(pixel) = pixel.filter(|pixel| sequence.camera.pinhole.contains(pixel, 1.0)) {
            let seen = photo.get_pixel(pixel.x.round() as u32, pixel.y.round() as u32).0;
            let difference: u32 = (0..3).map(|c| u32::from(seen[c].abs_diff(point.color[c]))).sum();
            let cell = nearest.entry(((pixel.x / CELL) as u32, (pixel.y / CELL) as u32)).or_insert((f64::INFINITY, 0));
            if p_in_camera.z < cell.0 {
                *cell = (p_in_camera.z, difference);
            }
        }
    }
    assert!(nearest.len() > 500, "points in only {} cells", nearest.len());
    let mut differences: Vec<u32> = nearest.values().map(|(_, difference)| *difference).collect();
    differences.sort_unstable();
    differences[differences.len() / 2]
}

/// The points of COLMAP's model have the colours of the photos where they are seen: poses, intrinsics and points belong together.
#[test]
fn photos_of_bonsai_show_the_points_of_their_model() {
    let Some(folder) = recorded("bonsai") else { return };
    let sequence = Sequence::open(&folder, None, None).unwrap();
    assert_eq!(
        (sequence.layout, sequence.sensor, sequence.entries.len()),
        (Layout::by_name("colmap").unwrap(), Sensor::Mono, 292)
    );
    assert_eq!(sequence.points.len(), 81_223);
    let poses = &sequence.groundtruth.as_ref().unwrap().poses;
    assert_eq!(poses.len(), 292);
    for index in (0..292).step_by(60) {
        let photo = sequence.load(index).unwrap().color;
        let difference_seen_from = |pose: usize| median_difference(&sequence, poses[pose].world_from_camera, &photo);
        let (own, other) = (difference_seen_from(index), difference_seen_from((index + 30) % 292));
        assert!(own * 2 < other, "photo {index}: its points differ by {own}, those of another pose by {other}");
    }
}

const VIDEO_FRAMES: usize = 40;
const VIDEO_FPS: f64 = 15.0;

/// A synthetic walk as Motion JPEG in AVI, its calibration in another folder: `(video, camera.toml)`.
fn video() -> (PathBuf, PathBuf) {
    let room = scratch().join("room");
    let camera = CameraConfig { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5, ..CameraConfig::default() };
    let walk = SceneConfig { camera, frames: VIDEO_FRAMES, fps: VIDEO_FPS, ..scene() };
    synthetic::generate(&walk, &room, &|_, _| {}).unwrap();
    let (path, calibration) = (scratch().join("walk.avi"), scratch().join("calibrations/own.toml"));
    let codec = VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
    let mut writer = VideoWriter::new(path.to_str().unwrap(), codec, VIDEO_FPS, Size::new(320, 240), true).unwrap();
    let images = Sequence::open(&room, None, None).unwrap();
    for index in 0..VIDEO_FRAMES {
        let mut values = images.load(index).unwrap().color.into_raw();
        values.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
        writer.write(&Mat::from_slice(&values).unwrap().reshape(3, 240).unwrap()).unwrap();
    }
    writer.release().unwrap();
    std::fs::create_dir(calibration.parent().unwrap()).unwrap();
    let pinhole = "[pinhole]\nfx = 262.5\nfy = 262.5\ncx = 159.5\ncy = 119.5\nwidth = 320\nheight = 240\n";
    std::fs::write(&calibration, pinhole).unwrap();
    (path, calibration)
}

/// A video that was not copied whole is mapped from what is there, and what is missing is counted.
#[test]
fn a_video_is_tracked_mapped_and_measured_again() {
    if skipped_without_adapter() {
        return;
    }
    let (video, calibration) = video();
    truncate(&video, std::fs::metadata(&video).unwrap().len() * 9 / 10);
    let out = scratch().join("video-out");
    let mut run = run_command(Path::new("walk.avi"), &out, &["--camera", "calibrations/own.toml", "--map-scale", "0.25"]);
    run.args(["--frames", "2.."]).current_dir(scratch());
    let said = finish(run).succeeded();
    let run = metrics(&out);
    assert_eq!((run.sequence.as_str(), run.frames), ("walk", VIDEO_FRAMES as u64 - 2));
    assert!((1..12).contains(&run.frames_read_failed), "{} frames", run.frames_read_failed);
    assert!(said.stderr.contains("frame 39 of ") && said.stderr.contains("walk.avi cannot be decoded"), "{}", said.stderr);
    assert!(run.frames_tracked >= 8, "{} frames tracked", run.frames_tracked);
    let on_the_grid = |stamp: &String| (stamp.parse::<f64>().unwrap() * VIDEO_FPS + 1e-3).fract() < 2e-3;
    assert!(stamps(&out.join("trajectory.txt")).iter().all(on_the_grid));
    let named = Config::read(&out.join("config.toml")).unwrap().sequence.unwrap();
    assert_eq!((named.path, named.camera.as_deref()), (video, calibration.to_str()));
    // Later, and from elsewhere: the same frames again.
    finish(keysplat([Path::new("eval"), &out])).succeeded();
    let (first, again) = (run.images.all_frames.unwrap(), metrics(&out).images.all_frames.unwrap());
    assert_eq!(first.count, again.count);
    // Poses are read back with the digits of their file.
    assert!((first.psnr_db.unwrap() - again.psnr_db.unwrap()).abs() < 1e-4, "{first:?}, then {again:?}");
}
