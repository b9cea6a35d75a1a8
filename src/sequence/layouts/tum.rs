//! The TUM RGB-D layout (Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012).
//!
//! `rgb.txt` and `depth.txt` list `timestamp file`; colour and depth are paired by nearest time. `camera.txt`, where present, gives
//! `fx fy cx cy width height depth_units_per_metre k1 k2 p1 p2 [k3]`.

use std::path::{Path, PathBuf};

use super::images;
use super::row::{LayoutRow, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole, Trajectory};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, cameras, folder_name, read_text};

/// Colour and depth further apart than this do not belong together (half a frame at 30 Hz, rounded up as the benchmark's tools do).
const MAX_TIME_DIFFERENCE_S: f64 = 0.02;
/// Of the benchmark's own depth images.
const DEPTH_UNITS_PER_METRE: f64 = 5000.0;

struct ListedImage {
    timestamp_s: f64,
    path: PathBuf,
}

/// A line of a list: its number, its time in seconds, its file.
type Listed<'a> = (usize, f64, &'a str);

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "tum",
    marker: "rgb.txt",
    help: "`rgb.txt`, `depth.txt`, `groundtruth.txt`, and `camera.txt` or a folder name that names a TUM camera.",
    is_photos: false,
    takes_camera: true,
    recognise: |folder| folder.join("rgb.txt").is_file(),
    open,
    parse: |bytes| parse_text(bytes, |text, path| vec![parse_list(text, path).map(drop), parse_camera(text, path).map(drop)]),
};

fn open(folder: &Path, camera: Option<&str>) -> Result<Sequence, SequenceError> {
    let name = folder_name(folder);
    let camera = match camera {
        Some(cameras::ASSUMED) => {
            let colors = read_list(folder, "rgb.txt")?;
            let first = colors.first().ok_or_else(|| SequenceError::Empty { path: folder.join("rgb.txt") })?;
            cameras::assumed_for(&first.path)?
        }
        Some(file) if cameras::is_file(file) => {
            let (camera, parsed) = images::parse_camera(&read_text(Path::new(file))?, Path::new(file))?;
            Camera { depth_units_per_metre: parsed.depth_units_per_metre.unwrap_or(DEPTH_UNITS_PER_METRE), ..camera }
        }
        Some(preset) => cameras::by_name(preset)?,
        None if folder.join("camera.txt").is_file() => {
            let path = folder.join("camera.txt");
            parse_camera(&read_text(&path)?, &path)?
        }
        None => cameras::by_folder(&name).ok_or_else(|| SequenceError::NoCamera { folder: folder.into() })?,
    };
    let colors = read_list(folder, "rgb.txt")?;
    let depth_list = folder.join("depth.txt");
    let depths = if depth_list.is_file() { read_list(folder, "depth.txt")? } else { Vec::new() };
    let entries: Vec<FrameEntry> = pair(colors, &depths);
    let sensor = if entries.iter().any(|entry| entry.depth.is_some()) { Sensor::Rgbd } else { Sensor::Mono };
    let groundtruth = folder.join("groundtruth.txt");
    let groundtruth = groundtruth.is_file().then(|| Trajectory::read_tum(&groundtruth)).transpose()?;
    let sequence = Sequence { groundtruth, ..Sequence::new(name, &LAYOUT, camera, sensor, entries) };
    sequence.check_first_size()?;
    Ok(sequence)
}

/// Pairs each colour image with the nearest depth image in time.
fn pair(colors: Vec<ListedImage>, depths: &[ListedImage]) -> Vec<FrameEntry> {
    let nearest = |t: f64| {
        let after = depths.partition_point(|d| d.timestamp_s < t);
        let candidates = depths[after.saturating_sub(1)..].iter().take(2);
        candidates
            .min_by(|a, b| (a.timestamp_s - t).abs().total_cmp(&(b.timestamp_s - t).abs()))
            .filter(|d| (d.timestamp_s - t).abs() <= MAX_TIME_DIFFERENCE_S)
    };
    colors
        .into_iter()
        .map(|color| FrameEntry {
            timestamp_s: color.timestamp_s,
            depth: nearest(color.timestamp_s).map(|d| d.path.clone()),
            color: color.path,
            ..FrameEntry::default()
        })
        .collect()
}

/// Reads a list, checked: see [`parse_list`], and its files are there.
fn read_list(folder: &Path, list_name: &str) -> Result<Vec<ListedImage>, SequenceError> {
    let list = folder.join(list_name);
    let text = read_text(&list)?;
    let listed = |(line, timestamp_s, file): Listed<'_>| {
        let path = folder.join(file);
        let missing = |image| SequenceError::MissingImage { list: list.clone(), line, image };
        if path.is_file() { Ok(ListedImage { timestamp_s, path }) } else { Err(missing(path)) }
    };
    parse_list(&text, &list)?.into_iter().map(listed).collect()
}

/// The lines `timestamp file` of a list: finite ascending times, at least one. `list` is named in errors.
pub(super) fn parse_list<'a>(text: &'a str, list: &Path) -> Result<Vec<Listed<'a>>, SequenceError> {
    let mut images: Vec<Listed<'_>> = Vec::new();
    for (index, raw) in text.lines().enumerate() {
        let line = index + 1;
        let syntax = |what: String| SequenceError::Syntax { path: list.into(), line, what };
        let content = raw.split('#').next().unwrap_or_default().trim();
        if content.is_empty() {
            continue;
        }
        let (time, file) =
            content.split_once(char::is_whitespace).ok_or_else(|| syntax(format!("`{content}` is not `timestamp file`")))?;
        let timestamp_s: f64 = time.parse().map_err(|_| syntax(format!("`{time}` is not a timestamp in seconds")))?;
        if !timestamp_s.is_finite() {
            return Err(syntax(format!("the timestamp `{time}` is not finite")));
        }
        if images.last().is_some_and(|(_, last_s, _)| timestamp_s <= *last_s) {
            return Err(syntax(format!(
                "the timestamp {time} is not after the one before it; sort the list by time and drop duplicates"
            )));
        }
        images.push((line, timestamp_s, file.trim()));
    }
    if images.is_empty() {
        return Err(SequenceError::Empty { path: list.into() });
    }
    Ok(images)
}

/// The camera of a `camera.txt`; `path` is named in errors.
pub(super) fn parse_camera(text: &str, path: &Path) -> Result<Camera, SequenceError> {
    let found = text.lines().enumerate().find(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    let (index, content) = found.ok_or_else(|| SequenceError::Empty { path: path.into() })?;
    let syntax = |what: String| SequenceError::Syntax { path: path.into(), line: index + 1, what };
    let numbers = content
        .split_whitespace()
        .map(|field| {
            field.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| syntax(format!("`{field}` is not a finite number")))
        })
        .collect::<Result<Vec<f64>, _>>()?;
    let [fx, fy, cx, cy, width, height, depth_units_per_metre, rest @ ..] = numbers.as_slice() else {
        return Err(syntax("expected `fx fy cx cy width height depth_units_per_metre k1 k2 p1 p2`".into()));
    };
    let positive = [fx, fy, width, height, depth_units_per_metre].into_iter().all(|v| *v > 0.0);
    if !positive || width.fract() != 0.0 || height.fract() != 0.0 || *width > 65_536.0 || *height > 65_536.0 {
        return Err(syntax("focal lengths, size (whole pixels) and depth units must be positive".into()));
    }
    let coefficient = |i: usize| rest.get(i).copied().unwrap_or(0.0);
    Ok(Camera {
        pinhole: Pinhole { fx: *fx, fy: *fy, cx: *cx, cy: *cy, width: *width as u32, height: *height as u32 },
        distortion: Distortion {
            k1: coefficient(0),
            k2: coefficient(1),
            p1: coefficient(2),
            p2: coefficient(3),
            k3: coefficient(4),
        },
        depth_units_per_metre: *depth_units_per_metre,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tiny recording in a temporary folder; each test spoils one thing.
    fn recording() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("rgb")).unwrap();
        std::fs::create_dir(folder.path().join("depth")).unwrap();
        for i in 0..3 {
            image::RgbImage::new(8, 6).save(folder.path().join(format!("rgb/{i}.png"))).unwrap();
            image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(8, 6, image::Luma([5000]))
                .save(folder.path().join(format!("depth/{i}.png")))
                .unwrap();
        }
        write(&folder, "camera.txt", "# fx\n5 5 3.5 2.5 8 6 5000 0 0 0 0\n");
        write(&folder, "rgb.txt", "# list\n0.0 rgb/0.png\n0.1 rgb/1.png\n0.2 rgb/2.png\n");
        write(&folder, "depth.txt", "0.004 depth/0.png\n0.15 depth/1.png\n0.19 depth/2.png\n");
        folder
    }

    fn write(folder: &tempfile::TempDir, name: &str, text: &str) {
        std::fs::write(folder.path().join(name), text).unwrap();
    }

    fn error(folder: &tempfile::TempDir) -> String {
        Sequence::open(folder.path(), None, None).map(|_| ()).unwrap_err().to_string()
    }

    #[test]
    fn pairs_by_time_and_reads_metres() {
        let folder = recording();
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        let has_depth: Vec<bool> = sequence.entries.iter().map(|e| e.depth.is_some()).collect();
        assert_eq!(has_depth, [true, false, true]);
        assert_eq!(sequence.load(0).unwrap().depth.unwrap().at(3, 3), Some(1.0));
    }

    #[test]
    fn bad_recordings_are_refused_with_file_and_line() {
        let spoil = |name: &str, text: &str| {
            let folder = recording();
            write(&folder, name, text);
            error(&folder)
        };
        assert!(error(&recording_without("rgb.txt")).contains("--layout"));
        assert!(error(&recording_without("camera.txt")).contains("--camera"));
        assert!(spoil("rgb.txt", "# none\n").contains("rgb.txt lists no frames"));
        assert!(spoil("rgb.txt", "0.1 rgb/0.png\n0.0 rgb/1.png\n").contains("rgb.txt:2: the timestamp 0.0 is not after"));
        assert!(spoil("rgb.txt", "0.1 rgb/9.png\n").contains("rgb.txt:1: there is no file"));
        assert!(spoil("rgb.txt", "x rgb/0.png\n").contains("rgb.txt:1: `x` is not a timestamp"));
        assert!(spoil("camera.txt", "5 5 3.5 2.5 8 nan 5000\n").contains("camera.txt:1: `nan`"));
        assert!(spoil("camera.txt", "5 5 3.5 2.5 16 6 5000\n").contains("is 8x6, but the camera is 16x6"));
        assert!(spoil("groundtruth.txt", "0 0 0 nan 0 0 0 1\n").contains("groundtruth.txt:1: `nan` is not finite"));
        assert!(Sequence::open(Path::new("/nowhere/at/all"), None, None).unwrap_err().to_string().contains("no folder"));
    }

    fn recording_without(name: &str) -> tempfile::TempDir {
        let folder = recording();
        std::fs::remove_file(folder.path().join(name)).unwrap();
        folder
    }

    #[test]
    fn a_truncated_image_is_an_error_that_names_it() {
        let folder = recording();
        let bytes = std::fs::read(folder.path().join("rgb/1.png")).unwrap();
        std::fs::write(folder.path().join("rgb/1.png"), &bytes[..bytes.len() / 2]).unwrap();
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        assert!(sequence.load(1).unwrap_err().to_string().contains("rgb/1.png"));
        assert!(sequence.load(2).is_ok());
    }

    #[test]
    fn selection_takes_a_range_then_a_stride() {
        let folder = recording();
        let mut sequence = Sequence::open(folder.path(), None, None).unwrap();
        sequence.select(Some(0..9), 2).unwrap();
        assert_eq!(sequence.entries.iter().map(|e| e.timestamp_s).collect::<Vec<_>>(), [0.0, 0.2]);
        assert!(sequence.select(Some(5..9), 1).is_err());
    }
}
