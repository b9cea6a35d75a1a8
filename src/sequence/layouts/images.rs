//! A plain folder of images with a `camera.toml`: for recordings that come in no dataset's layout.
//!
//! ```toml
//! fps = 20.0                       # 30 if left out
//! depth_units_per_metre = 1000.0   # with depth only
//! [pinhole]
//! fx = 525.0
//! fy = 525.0
//! cx = 319.5
//! cy = 239.5
//! width = 640
//! height = 480
//! [distortion]                     # none if left out; OpenCV's
//! k1 = 0.1
//! [stereo]                         # with pairs only, which must be rectified
//! baseline_metres = 0.12
//! ```
//!
//! The images are in the folder itself or in `rgb/`, perhaps with `depth/` (16-bit, registered); or in `left/` and `right/`. They go by
//! their sorted names, so numbers in these need leading zeros; what belongs together has the same name but for the extension.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::row::{LayoutRow, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, cameras, checks, folder_name, images_in, read_text};

pub(super) const FILE: &str = "camera.toml";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraFile {
    pinhole: Pinhole,
    #[serde(default)]
    distortion: Distortion,
    pub depth_units_per_metre: Option<f64>,
    #[serde(default = "usual_fps")]
    pub fps: f64,
    pub stereo: Option<StereoTable>,
}

impl CameraFile {
    /// A known camera, as a file would describe it.
    fn of(camera: Camera) -> (Camera, Self) {
        let depth_units_per_metre = Some(camera.depth_units_per_metre);
        let (pinhole, distortion) = (camera.pinhole, camera.distortion);
        (camera, Self { pinhole, distortion, depth_units_per_metre, fps: usual_fps(), stereo: None })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StereoTable {
    baseline_metres: f64,
}

pub(super) fn usual_fps() -> f64 {
    30.0
}

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "images",
    marker: "camera.toml",
    help: "`camera.toml` and images in the folder itself, in `rgb` and optionally `depth`, or in `left` and `right`.",
    is_photos: false,
    takes_camera: true,
    recognise,
    open,
    parse: |bytes| parse_text(bytes, |text, path| vec![parse_camera(text, path).map(drop)]),
};

pub(super) fn recognise(folder: &Path) -> bool {
    folder.join(FILE).is_file()
}

fn open(folder: &Path, named: Option<&str>) -> Result<Sequence, SequenceError> {
    let rgb = folder.join("rgb");
    if named == Some(cameras::ASSUMED) {
        let images = if rgb.is_dir() { rgb } else { folder.into() };
        let entries = entries(&images, Path::new(""), Sensor::Mono, usual_fps())?;
        let camera = cameras::assumed_for(&entries[0].color)?;
        return Ok(Sequence::new(folder_name(folder), &LAYOUT, camera, Sensor::Mono, entries));
    }
    let path = named.filter(|name| cameras::is_file(name)).map_or_else(|| folder.join(FILE), PathBuf::from);
    let content = |what: &str| SequenceError::Content { path: path.clone(), what: what.into() };
    let (camera, file) = match named {
        Some(preset) if !cameras::is_file(preset) => CameraFile::of(cameras::by_name(preset)?),
        _ => parse_camera(&read_text(&path)?, &path)?,
    };
    let (color_folder, other_folder, sensor) = match file.stereo {
        Some(StereoTable { baseline_metres }) => {
            if !(baseline_metres.is_finite() && baseline_metres > 0.0) {
                return Err(content("baseline_metres must be positive"));
            }
            if !camera.distortion.is_zero() {
                return Err(content("stereo pairs must be rectified: remove the distortion from them, and [distortion] here"));
            }
            (folder.join("left"), folder.join("right"), Sensor::Stereo { baseline_metres })
        }
        None if folder.join("depth").is_dir() => {
            if file.depth_units_per_metre.is_none() {
                return Err(content("there is a folder depth, but no depth_units_per_metre"));
            }
            (rgb, folder.join("depth"), Sensor::Rgbd)
        }
        None if rgb.is_dir() => (rgb, PathBuf::new(), Sensor::Mono),
        None => (folder.into(), PathBuf::new(), Sensor::Mono),
    };
    let entries = entries(&color_folder, &other_folder, sensor, file.fps)?;
    let sequence = Sequence::new(folder_name(folder), &LAYOUT, camera, sensor, entries);
    sequence.check_first_size()?;
    Ok(sequence)
}

/// Parses a camera's file and checks its numbers; `path` is named in errors.
pub(super) fn parse_camera(text: &str, path: &Path) -> Result<(Camera, CameraFile), SequenceError> {
    let content = |what: String| SequenceError::Content { path: path.into(), what };
    let file = parse_camera_file(text, path)?;
    let depth_units_per_metre = file.depth_units_per_metre.unwrap_or(1.0);
    let camera = checks::camera(Camera { pinhole: file.pinhole, distortion: file.distortion, depth_units_per_metre });
    if !(file.fps.is_finite() && file.fps > 0.0) {
        return Err(content("fps must be positive".into()));
    }
    Ok((camera.map_err(content)?, file))
}

fn parse_camera_file(text: &str, path: &Path) -> Result<CameraFile, SequenceError> {
    toml::from_str(text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        let line = before.matches('\n').count() + 1;
        SequenceError::Syntax { path: path.into(), line, what: error.message().into() }
    })
}

/// The images of a folder, each with its like-named depth or right image from the other one.
fn entries(folder: &Path, other_folder: &Path, sensor: Sensor, fps: f64) -> Result<Vec<FrameEntry>, SequenceError> {
    let stem = |path: &PathBuf| path.file_stem().map(OsString::from);
    let others = if sensor == Sensor::Mono { Vec::new() } else { images_in(other_folder)? };
    let mut others: BTreeMap<_, _> = others.into_iter().map(|path| (stem(&path), path)).collect();
    let mut entries = Vec::new();
    for (index, color) in images_in(folder)?.into_iter().enumerate() {
        let other = others.remove(&stem(&color));
        let (depth, right) = if sensor == Sensor::Rgbd { (other, None) } else { (None, other) };
        entries.push(FrameEntry { timestamp_s: index as f64 / fps, color, depth, right, ..FrameEntry::default() });
    }
    if entries.is_empty() {
        return Err(SequenceError::Empty { path: folder.into() });
    }
    if sensor != Sensor::Mono && entries.iter().all(|entry| entry.depth.is_none() && entry.right.is_none()) {
        let what = format!("no image here has the name of one in {}", folder.display());
        return Err(SequenceError::Content { path: other_folder.into(), what });
    }
    Ok(entries)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sequence::SensorKind;

    const PINHOLE: &str = "[pinhole]\nfx = 5.0\nfy = 5\ncx = 3.5\ncy = 2.5\nwidth = 8\nheight = 6\n";

    /// Two images in each of the folders, and the camera's file.
    fn recording(camera: &str, folders: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in folders {
            std::fs::create_dir_all(folder.path().join(name)).unwrap();
            for i in [2, 10] {
                let path = folder.path().join(name).join(format!("{i:03}.png"));
                if *name == "depth" {
                    image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(8, 6, image::Luma([500])).save(path).unwrap();
                } else {
                    image::RgbImage::new(8, 6).save(path).unwrap();
                }
            }
        }
        std::fs::write(folder.path().join(FILE), camera).unwrap();
        folder
    }

    fn open(folder: &tempfile::TempDir) -> Result<Sequence, String> {
        Sequence::open(folder.path(), None, None).map_err(|error| error.to_string())
    }

    #[test]
    fn the_folders_say_what_the_sensor_is() {
        for place in [".", "rgb"] {
            let sequence = open(&recording(&format!("fps = 4\n{PINHOLE}[distortion]\nk1 = 0.1\n"), &[place])).unwrap();
            assert_eq!(
                (sequence.layout, sequence.sensor, sequence.entries.len()),
                (crate::sequence::Layout::of(&LAYOUT), Sensor::Mono, 2)
            );
            assert_eq!((sequence.camera.distortion.k1, sequence.entries[1].timestamp_s), (0.1, 0.25));
            assert!(sequence.groundtruth.is_none());
        }
        let folder = recording(&format!("depth_units_per_metre = 1000.0\n{PINHOLE}"), &["rgb", "depth"]);
        let mut sequence = open(&folder).unwrap();
        assert_eq!((sequence.sensor, sequence.entries[1].timestamp_s), (Sensor::Rgbd, 1.0 / 30.0));
        assert_eq!(sequence.load(1).unwrap().depth.unwrap().at(0, 0), Some(0.5));
        sequence.restrict_to(SensorKind::Mono).unwrap();
        assert!(sequence.load(1).unwrap().depth.is_none());
        let folder = recording(&format!("{PINHOLE}[stereo]\nbaseline_metres = 0.12\n"), &["left", "right"]);
        std::fs::remove_file(folder.path().join("right/002.png")).unwrap();
        let sequence = open(&folder).unwrap();
        assert_eq!(sequence.sensor, Sensor::Stereo { baseline_metres: 0.12 });
        assert!(sequence.load(0).unwrap().right.is_none() && sequence.load(1).unwrap().right.is_some());
    }

    /// The documentation shows a file that is read as it stands.
    #[test]
    fn the_example_in_the_documentation_is_valid() {
        let page = include_str!("../../../docs/recordings.md");
        let example = page.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
        let folder = recording(example, &[]);
        assert!(open(&folder).unwrap_err().contains("lists no frames"));
        std::fs::write(folder.path().join(FILE), example.replace("# stereo", "stereo")).unwrap();
        assert!(parse_camera_file(&read_text(&folder.path().join(FILE)).unwrap(), Path::new(FILE)).unwrap().stereo.is_some());
    }

    #[test]
    fn faults_name_the_file_and_what_is_wrong_in_it() {
        let refused = |camera: &str, folders: &[&str], part: &str| {
            let message = open(&recording(camera, folders)).map(|_| ()).unwrap_err();
            assert!(message.contains(part), "{message}");
        };
        let stereo = format!("{PINHOLE}[stereo]\nbaseline_metres = 0.12\n");
        refused(&PINHOLE.replace("2.5", "x"), &["."], "camera.toml:5: ");
        refused(&PINHOLE.replace("cx", "centre"), &["."], "camera.toml:4: unknown field `centre`");
        refused(&PINHOLE.replace("5.0", "0.0"), &["."], "camera.toml: a camera needs");
        refused(&PINHOLE.replace("height = 6", "height = 7"), &["."], "is 8x6, but the camera is 8x7");
        refused(&format!("fps = 0\n{PINHOLE}"), &["."], "fps must be positive");
        refused(PINHOLE, &[], "lists no frames");
        refused(PINHOLE, &["rgb", "depth"], "no depth_units_per_metre");
        refused(&stereo.replace("0.12", "-0.12"), &["left", "right"], "baseline_metres must be positive");
        refused(&format!("{stereo}[distortion]\nk1 = 0.1\n"), &["left", "right"], "must be rectified");
        refused(&stereo, &["left"], "right");
        let strangers = recording(&stereo, &["left", "right"]);
        for name in ["002", "010"] {
            let right = strangers.path().join("right");
            std::fs::rename(right.join(format!("{name}.png")), right.join(format!("r{name}.png"))).unwrap();
        }
        assert!(open(&strangers).unwrap_err().contains("no image here has the name of one in"));
        let folder = recording(PINHOLE, &["."]);
        for (camera, part) in [("nosuch", "no camera is called `nosuch`"), ("tum-fr1", "the camera is 640x480")] {
            let message = Sequence::open(folder.path(), None, Some(camera)).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
