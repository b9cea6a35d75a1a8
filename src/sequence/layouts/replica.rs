//! Renders of the Replica rooms (Straub et al., 2019) as NICE-SLAM (Zhu et al., CVPR 2022) lays them out.
//!
//! `results/frameNNNNNN.jpg` and `results/depthNNNNNN.png`; line N of `traj.txt` (from 0) is frame N's pose, a 4×4 matrix, camera to
//! world, row-major. `cam_params.json`, beside or one folder up, has the camera of all rooms. Frame N is taken at N/30 seconds.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::row::{LayoutRow, SAMPLE_FRAMES, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole, StampedPose, Trajectory};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, checks, folder_name, images_in, parse_json, read_text};

const FRAMES_PER_S: f64 = 30.0;

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "replica",
    marker: "traj.txt and results",
    help: "`results/frame*.jpg` and `results/depth*.png`, `traj.txt`, and `cam_params.json` there or one folder up.",
    is_photos: false,
    takes_camera: false,
    recognise,
    open: |folder, _| open(folder),
    parse: |bytes| {
        parse_text(bytes, |text, path| {
            let frames: Vec<usize> = (0..SAMPLE_FRAMES).collect();
            vec![parse_camera(text, path).map(drop), parse_poses(text, path, frames.iter()).map(drop)]
        })
    },
};

fn recognise(folder: &Path) -> bool {
    folder.join("traj.txt").is_file() && folder.join("results").is_dir()
}

fn open(folder: &Path) -> Result<Sequence, SequenceError> {
    let results = folder.join("results");
    let images = images_in(&results)?;
    let (colors, depths) = (numbered(&images, "frame"), numbered(&images, "depth"));
    let entry = |(number, color): (&usize, &PathBuf)| FrameEntry {
        timestamp_s: timestamp_s(*number),
        color: color.clone(),
        depth: depths.get(number).cloned(),
        ..FrameEntry::default()
    };
    let entries: Vec<FrameEntry> = colors.iter().map(entry).collect();
    if entries.is_empty() {
        return Err(SequenceError::Empty { path: results });
    }
    let sensor = if entries.iter().any(|entry| entry.depth.is_some()) { Sensor::Rgbd } else { Sensor::Mono };
    let truth = folder.join("traj.txt");
    let groundtruth = Some(parse_poses(&read_text(&truth)?, &truth, colors.keys())?);
    let camera = read_camera(folder)?;
    let sequence = Sequence { groundtruth, ..Sequence::new(folder_name(folder), &LAYOUT, camera, sensor, entries) };
    sequence.check_first_size()?;
    Ok(sequence)
}

fn timestamp_s(number: usize) -> f64 {
    number as f64 / FRAMES_PER_S
}

/// The pictures called `prefix` and a number, by that number.
fn numbered(images: &[PathBuf], prefix: &str) -> BTreeMap<usize, PathBuf> {
    let number = |path: &PathBuf| path.file_stem()?.to_str()?.strip_prefix(prefix)?.parse().ok();
    images.iter().filter_map(|path| Some((number(path)?, path.clone()))).collect()
}

#[derive(Deserialize)]
struct CameraFile {
    camera: CameraNumbers,
}

#[derive(Deserialize)]
struct CameraNumbers {
    w: u32,
    h: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    /// Depth units per metre.
    scale: f64,
}

fn read_camera(folder: &Path) -> Result<Camera, SequenceError> {
    let places = ["cam_params.json", "../cam_params.json"].map(|name| folder.join(name));
    let path = places.into_iter().find(|path| path.is_file()).ok_or_else(|| SequenceError::Content {
        path: folder.into(),
        what: "there is no cam_params.json here or one folder up; copy the one that comes with the rooms".into(),
    })?;
    parse_camera(&read_text(&path)?, &path)
}

/// The camera of a `cam_params.json`; `path` is named in errors.
pub(super) fn parse_camera(text: &str, path: &Path) -> Result<Camera, SequenceError> {
    let CameraNumbers { w, h, fx, fy, cx, cy, scale } = parse_json::<CameraFile>(text, path)?.camera;
    let pinhole = Pinhole { fx, fy, cx, cy, width: w, height: h };
    checks::camera(Camera { pinhole, distortion: Distortion::default(), depth_units_per_metre: scale })
        .map_err(|what| SequenceError::Content { path: path.into(), what })
}

/// The poses of the frames with these numbers; `path` is named in errors.
pub(super) fn parse_poses<'a>(
    text: &str,
    path: &Path,
    frames: impl Iterator<Item = &'a usize>,
) -> Result<Trajectory, SequenceError> {
    let lines: Vec<(usize, &str)> = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()).collect();
    let mut poses = Vec::new();
    for &number in frames {
        let &(index, line) = lines.get(number).ok_or_else(|| SequenceError::Content {
            path: path.into(),
            what: format!("{} poses, none for frame {number}; check that the recording was copied whole", lines.len()),
        })?;
        let world_from_camera = checks::numbers(line, 16)
            .and_then(|matrix| checks::rigid(&matrix))
            .map_err(|what| SequenceError::Syntax { path: path.into(), line: index + 1, what })?;
        poses.push(StampedPose { timestamp_s: timestamp_s(number), world_from_camera });
    }
    Ok(Trajectory { poses })
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: &str = r#"{ "camera": { "w": 8, "h": 6, "fx": 7.0, "fy": 7.0, "cx": 3.5, "cy": 2.5, "scale": 6553.5 } }"#;
    const POSES: &str = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n0 0 1 4 1 0 0 5 0 1 0 6 0 0 0 1\n1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1\n";

    /// Three frames in `room`; the last has no depth. The camera is one folder up.
    fn recording() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let room = folder.path().join("room");
        std::fs::create_dir_all(room.join("results")).unwrap();
        for i in 0..3 {
            image::RgbImage::new(8, 6).save(room.join(format!("results/frame{i:06}.jpg"))).unwrap();
        }
        for i in 0..2 {
            let depth = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(8, 6, image::Luma([13_107]));
            depth.save(room.join(format!("results/depth{i:06}.png"))).unwrap();
        }
        std::fs::write(room.join("traj.txt"), POSES).unwrap();
        std::fs::write(folder.path().join("cam_params.json"), CAMERA).unwrap();
        (folder, room)
    }

    #[test]
    fn frames_depth_camera_and_poses_are_read() {
        let (_folder, room) = recording();
        let sequence = Sequence::open(&room, None, None).unwrap();
        assert_eq!((sequence.layout, sequence.sensor), (crate::sequence::Layout::of(&LAYOUT), Sensor::Rgbd));
        let has_depth: Vec<bool> = sequence.entries.iter().map(|entry| entry.depth.is_some()).collect();
        assert_eq!(has_depth, [true, true, false]);
        assert_eq!(sequence.load(1).unwrap().depth.unwrap().at(3, 3), Some(2.0));
        let pose = sequence.groundtruth.unwrap().poses[1];
        assert_eq!(pose.timestamp_s, 1.0 / 30.0);
        // z of the camera is x of the world.
        let ahead = pose.world_from_camera * nalgebra::Point3::new(0.0, 0.0, 1.0);
        assert!((ahead - nalgebra::Point3::new(5.0, 5.0, 6.0)).norm() < 1e-12);
    }

    /// A part of a recording keeps its times and poses.
    #[test]
    fn frames_are_known_by_their_numbers() {
        let (_folder, room) = recording();
        std::fs::remove_file(room.join("results/frame000000.jpg")).unwrap();
        let sequence = Sequence::open(&room, None, None).unwrap();
        let first = (sequence.entries[0].timestamp_s, sequence.groundtruth.unwrap().poses[0].world_from_camera.translation.z);
        assert_eq!(first, (1.0 / 30.0, 6.0));
    }

    #[test]
    fn faults_name_the_file_and_the_line() {
        let (folder, room) = recording();
        let refused = |part: &str| {
            let message = Sequence::open(&room, None, None).map(|_| ()).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        };
        let write = |text: &str| std::fs::write(room.join("traj.txt"), text).unwrap();
        write(&POSES.replace("4 1 0 0 5", "4 1 0 0 nan"));
        refused("traj.txt:2: expected 16 finite numbers");
        write(&POSES.replace("0 0 1 4", "0 0 2 4"));
        refused("traj.txt:2: the first three columns are no rotation");
        write(POSES.split_once('\n').unwrap().0);
        refused("traj.txt: 1 poses, none for frame 1");
        write(POSES);
        let camera = folder.path().join("cam_params.json");
        std::fs::write(&camera, CAMERA.replace("6553.5", "0")).unwrap();
        refused("cam_params.json: a camera needs");
        std::fs::write(&camera, CAMERA.replace("\"w\": 8", "\"w\":\n\"x\"")).unwrap();
        refused("cam_params.json:2: ");
        std::fs::write(&camera, CAMERA.replace("\"w\": 8", "\"w\": 9")).unwrap();
        refused("is 8x6, but the camera is 9x6");
        std::fs::remove_file(camera).unwrap();
        refused("no cam_params.json");
        std::fs::remove_dir_all(room.join("results")).unwrap();
        std::fs::create_dir(room.join("results")).unwrap();
        refused("results lists no frames");
    }
}
