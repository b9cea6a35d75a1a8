//! The layout of KITTI's odometry benchmark (Geiger et al., CVPR 2012): rectified stereo pairs, one folder a camera.
//!
//! `image_2` and `image_3` (colour), else `image_0` and `image_1`, else `image_l` and `image_r`; the right one may be missing.
//! `calib.txt` holds a 3×4 projection per camera, named (`P0: …`) or in the order left, right. `times.txt`, in seconds, may be missing:
//! the recordings run at 10 Hz. `poses.txt`, or `poses/NN.txt` two folders up, holds the truth: 3×4, camera to world.

use std::path::{Path, PathBuf};

use super::row::{LayoutRow, SAMPLE_FRAMES, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole, StampedPose, Trajectory};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, checks, folder_name, images_in, read_text};

const FRAME_S: f64 = 0.1;
/// Folder of the left and of the right images, and their cameras in a calibration that names them.
const CAMERAS: [(&str, &str, &str, &str); 3] =
    [("image_2", "image_3", "P2", "P3"), ("image_0", "image_1", "P0", "P1"), ("image_l", "image_r", "P0", "P1")];

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "kitti",
    marker: "calib.txt and image_0",
    help: "`image_0` and `image_1` (or `image_2` and `image_3`), `calib.txt`, optionally `times.txt` and `poses.txt`.",
    is_photos: false,
    takes_camera: false,
    recognise,
    open: |folder, _| open(folder),
    parse: |bytes| {
        parse_text(bytes, |text, path| {
            let projection = Calibration::parse(text, path).and_then(|c| c.of("P0", 0).map(drop));
            let poses = parse_poses(text, path, &[0.0; SAMPLE_FRAMES]).map(drop);
            vec![projection, parse_times(text, path, SAMPLE_FRAMES).map(drop), poses]
        })
    },
};

fn recognise(folder: &Path) -> bool {
    folder.join("calib.txt").is_file() && CAMERAS.iter().any(|(left, ..)| folder.join(left).is_dir())
}

fn open(folder: &Path) -> Result<Sequence, SequenceError> {
    let (left, right, left_name, right_name) = CAMERAS
        .into_iter()
        .find(|(left, ..)| folder.join(left).is_dir())
        .ok_or_else(|| SequenceError::Missing(folder.join(CAMERAS[0].0)))?;
    let lefts = images_in(&folder.join(left))?;
    let rights = if folder.join(right).is_dir() { images_in(&folder.join(right))? } else { Vec::new() };
    let calibration = folder.join("calib.txt");
    let calibration = Calibration::parse(&read_text(&calibration)?, &calibration)?;
    let first = lefts.first().ok_or_else(|| SequenceError::Empty { path: folder.join(left) })?;
    let (width, height) =
        image::image_dimensions(first).map_err(|source| SequenceError::Image { path: first.clone(), source })?;
    let projection = calibration.of(left_name, 0)?;
    let pinhole = Pinhole { fx: projection[0], fy: projection[5], cx: projection[2], cy: projection[6], width, height };
    let right_of = |path: &PathBuf| rights.iter().find(|r| r.file_name() == path.file_name()).cloned();
    let sensor = if rights.is_empty() {
        Sensor::Mono
    } else {
        // The fourth column is -fx times the distance from the reference camera.
        let other = calibration.of(right_name, 1)?;
        let baseline_metres = projection[3] / projection[0] - other[3] / other[0];
        if baseline_metres > 0.0 {
            Sensor::Stereo { baseline_metres }
        } else {
            return Err(calibration.wrong("the right camera is not to the right of the left one"));
        }
    };
    let times = read_times(&folder.join("times.txt"), lefts.len())?;
    let entries: Vec<FrameEntry> = lefts
        .into_iter()
        .zip(&times)
        .map(|(color, &timestamp_s)| FrameEntry { timestamp_s, right: right_of(&color), color, ..FrameEntry::default() })
        .collect();
    let groundtruth = truth_file(folder).map(|path| parse_poses(&read_text(&path)?, &path, &times)).transpose()?;
    let camera = Camera { pinhole, distortion: Distortion::default(), depth_units_per_metre: 1.0 };
    Ok(Sequence { groundtruth, ..Sequence::new(folder_name(folder), &LAYOUT, camera, sensor, entries) })
}

/// The projections of a calibration file, each with its name where it has one.
pub(super) struct Calibration {
    path: PathBuf,
    projections: Vec<(Option<String>, Vec<f64>)>,
}

impl Calibration {
    /// `path` is named in errors.
    pub(super) fn parse(text: &str, path: &Path) -> Result<Self, SequenceError> {
        let mut projections = Vec::new();
        for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
            let (name, numbers) = match line.split_once(':') {
                Some((name, rest)) => (Some(name.trim().to_owned()), rest),
                None => (None, line),
            };
            // Calibrations hold other things too, such as a lidar's pose.
            if name.as_deref().is_some_and(|name| !name.starts_with('P')) {
                continue;
            }
            projections.push((name, checks::numbers(numbers, 12).map_err(|what| syntax(path, index, what))?));
        }
        Ok(Self { path: path.into(), projections })
    }

    /// The projection of that name, or at that place where they have no names.
    pub(super) fn of(&self, name: &str, place: usize) -> Result<&[f64], SequenceError> {
        let named = self.projections.iter().find(|(n, _)| n.as_deref() == Some(name));
        let found = named.or_else(|| self.projections.get(place).filter(|(n, _)| n.is_none()));
        let (_, projection) = found.ok_or_else(|| self.wrong(&format!("there is no projection {name}")))?;
        if projection[0] > 0.0 && projection[5] > 0.0 {
            Ok(projection)
        } else {
            Err(self.wrong("focal lengths must be positive"))
        }
    }

    fn wrong(&self, what: &str) -> SequenceError {
        syntax(&self.path, 0, what.into())
    }
}

fn syntax(path: &Path, index: usize, what: String) -> SequenceError {
    SequenceError::Syntax { path: path.into(), line: index + 1, what }
}

fn read_times(path: &Path, frames: usize) -> Result<Vec<f64>, SequenceError> {
    if !path.is_file() {
        return Ok((0..frames).map(|i| i as f64 * FRAME_S).collect());
    }
    parse_times(&read_text(path)?, path, frames)
}

/// The times of so many frames, seconds; `path` is named in errors.
pub(super) fn parse_times(text: &str, path: &Path, frames: usize) -> Result<Vec<f64>, SequenceError> {
    let mut times: Vec<f64> = Vec::new();
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let time: f64 = line.trim().parse().map_err(|_| syntax(path, index, format!("`{line}` is not a time in seconds")))?;
        if !time.is_finite() || times.last().is_some_and(|last| time <= *last) {
            return Err(syntax(path, index, format!("the time {line} is not finite and after the one before it")));
        }
        times.push(time);
    }
    if times.len() < frames {
        return Err(syntax(path, times.len(), format!("{} times for {frames} images", times.len())));
    }
    Ok(times)
}

fn truth_file(folder: &Path) -> Option<PathBuf> {
    let beside = folder.join("poses.txt");
    let elsewhere = folder.join("../../poses").join(format!("{}.txt", folder_name(folder)));
    [beside, elsewhere].into_iter().find(|path| path.is_file())
}

/// The truth at those times, seconds; `path` is named in errors.
pub(super) fn parse_poses(text: &str, path: &Path, times: &[f64]) -> Result<Trajectory, SequenceError> {
    let mut poses = Vec::new();
    for ((index, line), &timestamp_s) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()).zip(times) {
        let m = checks::numbers(line, 12).map_err(|what| syntax(path, index, what))?;
        let world_from_camera = checks::rigid(&m).map_err(|what| syntax(path, index, what))?;
        poses.push(StampedPose { timestamp_s, world_from_camera });
    }
    Ok(Trajectory { poses })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(folder: &Path, name: &str, text: &str) {
        std::fs::write(folder.join(name), text).unwrap();
    }

    fn recording() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for side in ["image_0", "image_1"] {
            std::fs::create_dir(folder.path().join(side)).unwrap();
            for i in 0..3 {
                image::GrayImage::new(8, 6).save(folder.path().join(side).join(format!("{i:06}.png"))).unwrap();
            }
        }
        let (p0, p1) = ("7 0 4 0 0 7 3 0 0 0 1 0", "7 0 4 -3.5 0 7 3 0 0 0 1 0");
        write(folder.path(), "calib.txt", &format!("P0: {p0}\nP1: {p1}\nTr: 1 0 0\n"));
        write(folder.path(), "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 0.5\n1 0 0 0 0 1 0 0 0 0 1 1\n");
        folder
    }

    #[test]
    fn pairs_calibration_times_and_truth_are_read() {
        let folder = recording();
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        assert_eq!(
            (sequence.layout, sequence.sensor),
            (crate::sequence::Layout::of(&LAYOUT), Sensor::Stereo { baseline_metres: 0.5 })
        );
        assert_eq!(sequence.camera.pinhole.fx, 7.0);
        assert!(sequence.entries.iter().all(|e| e.right.is_some()));
        assert!((sequence.entries[2].timestamp_s - 0.2).abs() < 1e-12);
        assert_eq!(sequence.groundtruth.as_ref().unwrap().poses[2].world_from_camera.translation.z, 1.0);
        assert!(sequence.load(1).unwrap().right.is_some());
        write(folder.path(), "times.txt", "0\n0.25\n0.5\n");
        assert_eq!(Sequence::open(folder.path(), None, None).unwrap().entries[1].timestamp_s, 0.25);
    }

    #[test]
    fn faults_name_the_file_and_the_line() {
        let folder = recording();
        let error = || Sequence::open(folder.path(), None, None).unwrap_err().to_string();
        write(folder.path(), "times.txt", "0\n0.5\n0.25\n");
        assert!(error().contains("times.txt:3"), "{}", error());
        std::fs::remove_file(folder.path().join("times.txt")).unwrap();
        write(folder.path(), "poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n");
        assert!(error().contains("poses.txt:1: expected 12 finite numbers"), "{}", error());
        write(folder.path(), "calib.txt", "P0: 7 0 4 0 0 7 3 0 0 0 1 0\n");
        assert!(error().contains("no projection P1"), "{}", error());
        std::fs::remove_file(folder.path().join("image_0/000001.png")).unwrap();
    }
}
