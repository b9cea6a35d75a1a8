//! The layout of the EuRoC MAV datasets (Burri et al., IJRR 2016): raw stereo, rectified here by its own calibration.
//!
//! `mav0/cam0` and `mav0/cam1`, each with `data.csv` (`timestamp [ns],file`), `data/` and `sensor.yaml` (radial-tangential lens, and
//! `T_BS`, the camera's pose in the body). Without `cam1` the recording is monocular and keeps its distortion. The truth of
//! `mav0/state_groundtruth_estimate0/data.csv` is the body's (`timestamp [ns],p x y z,q w x y z,…`); we give the camera's.
//!
//! Left out: the inertial measurements, and lenses of other models (TUM-VI's fisheye), which are refused.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::UnitQuaternion;
use serde::Deserialize;

use super::row::{LayoutRow, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole, Se3, StampedPose, Trajectory};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, checks, folder_name, read_text, stereo};

/// Left and right further apart than this do not belong together: the cameras are triggered by one signal.
const MAX_PAIR_NS: u64 = 1_000_000;
/// Values in a `sensor.yaml`; the datasets' have about 50.
const MAX_NODES: usize = 10_000;

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "euroc",
    marker: "mav0/cam0",
    help: "`mav0/cam0` and optionally `mav0/cam1`, each with `data.csv`, `sensor.yaml` and `data`.",
    is_photos: false,
    takes_camera: false,
    recognise,
    open: |folder, _| open(folder),
    parse: |bytes| {
        parse_text(bytes, |text, path| {
            vec![
                parse_sensor(text, path).map(drop),
                parse_rows(text, path).map(drop),
                parse_truth(text, path, &Se3::identity()).map(drop),
            ]
        })
    },
};

fn recognise(folder: &Path) -> bool {
    folder.join("mav0/cam0/data.csv").is_file()
}

fn open(folder: &Path) -> Result<Sequence, SequenceError> {
    let (left, right) = (folder.join("mav0/cam0"), folder.join("mav0/cam1"));
    let lefts = read_list(&left)?;
    let has_right = right.join("data.csv").is_file();
    let rights = if has_right { read_list(&right)? } else { Vec::new() };
    let sensor = left.join("sensor.yaml");
    let (camera, mut body_from_camera) = parse_sensor(&read_text(&sensor)?, &sensor)?;
    let entry = |left: ListedImage| FrameEntry {
        timestamp_s: seconds(left.timestamp_ns),
        right: nearest(&rights, left.timestamp_ns),
        color: left.path,
        ..FrameEntry::default()
    };
    let entries = lefts.into_iter().map(entry).collect();
    let mut sequence = Sequence::new(folder_name(folder), &LAYOUT, camera, Sensor::Mono, entries);
    // Before the maps are made, which are as large as the calibration says.
    sequence.check_first_size()?;
    if has_right {
        let rectified_from_left = rectify(&mut sequence, &right, &body_from_camera)?;
        body_from_camera *= rectified_from_left.inverse();
    }
    let truth = folder.join("mav0/state_groundtruth_estimate0/data.csv");
    sequence.groundtruth = truth.is_file().then(|| parse_truth(&read_text(&truth)?, &truth, &body_from_camera)).transpose()?;
    Ok(sequence)
}

/// Makes the recording one of rectified pairs; says how its left camera is turned for that.
fn rectify(sequence: &mut Sequence, right: &Path, body_from_left: &Se3) -> Result<UnitQuaternion<f64>, SequenceError> {
    if sequence.entries.iter().all(|entry| entry.right.is_none()) {
        let what = "no image has the time of one of cam0, to a millisecond; are the two of one recording?".into();
        return Err(SequenceError::Content { path: right.join("data.csv"), what });
    }
    let path = right.join("sensor.yaml");
    let (right_camera, body_from_right) = parse_sensor(&read_text(&path)?, &path)?;
    let pair = stereo::rectify(&sequence.camera, &right_camera, &(body_from_left.inverse() * body_from_right))
        .map_err(|what| SequenceError::Content { path, what })?;
    sequence.camera = Camera { pinhole: pair.pinhole, distortion: Distortion::default(), ..sequence.camera };
    sequence.sensor = Sensor::Stereo { baseline_metres: pair.baseline_metres };
    sequence.remap = Some(Arc::new(pair.remap));
    Ok(pair.rectified_from_left)
}

/// A camera's calibration file, as far as we need it.
#[derive(Deserialize)]
struct SensorFile {
    #[serde(rename = "T_BS")]
    body_from_sensor: Matrix,
    resolution: [u32; 2],
    camera_model: String,
    intrinsics: [f64; 4],
    distortion_model: String,
    distortion_coefficients: [f64; 4],
}

#[derive(Deserialize)]
struct Matrix {
    data: Vec<f64>,
}

/// A camera, and its pose in the body's frame, from a `sensor.yaml`; `path` is named in errors.
pub(super) fn parse_sensor(text: &str, path: &Path) -> Result<(Camera, Se3), SequenceError> {
    let content = |what: String| SequenceError::Content { path: path.into(), what };
    // A calibration needs no anchors, and aliases of aliases may stand for more than any memory holds.
    let budget = serde_saphyr::budget! { max_anchors: 0, max_aliases: 0, max_nodes: MAX_NODES };
    let options = serde_saphyr::options! { budget: budget };
    let file: SensorFile = serde_saphyr::from_str_with_options(text, options).map_err(|error| {
        let what = match error.without_snippet() {
            serde_saphyr::Error::Budget { .. } => "anchors, aliases, or more values than a calibration has".into(),
            error => error.to_string(),
        };
        match error.location() {
            Some(place) => SequenceError::Syntax { path: path.into(), line: place.line() as usize, what },
            None => content(what),
        }
    })?;
    if file.camera_model != "pinhole" || file.distortion_model != "radial-tangential" {
        let (camera, lens) = (&file.camera_model, &file.distortion_model);
        return Err(content(format!(
            "{camera} cameras with {lens} lenses are not known here, only pinhole with radial-tangential"
        )));
    }
    let ([width, height], [fx, fy, cx, cy]) = (file.resolution, file.intrinsics);
    let [k1, k2, p1, p2] = file.distortion_coefficients;
    let camera = checks::camera(Camera {
        pinhole: Pinhole { fx, fy, cx, cy, width, height },
        distortion: Distortion { k1, k2, p1, p2, k3: 0.0 },
        depth_units_per_metre: 1.0,
    });
    let body_from_camera = checks::rigid(&file.body_from_sensor.data).map_err(|what| format!("T_BS: {what}"));
    Ok((camera.map_err(content)?, body_from_camera.map_err(content)?))
}

struct ListedImage {
    timestamp_ns: u64,
    path: PathBuf,
}

/// The images of one camera, checked: ascending times, existing files, at least one.
fn read_list(camera: &Path) -> Result<Vec<ListedImage>, SequenceError> {
    let list = camera.join("data.csv");
    let mut images: Vec<ListedImage> = Vec::new();
    for row in parse_rows(&read_text(&list)?, &list)? {
        let file = row.fields.first().ok_or_else(|| syntax(&list, row.line, "expected `timestamp [ns],file`".into()))?;
        let path = camera.join("data").join(file);
        if !path.is_file() {
            return Err(SequenceError::MissingImage { list, line: row.line, image: path });
        }
        images.push(ListedImage { timestamp_ns: row.timestamp_ns, path });
    }
    if images.is_empty() { Err(SequenceError::Empty { path: list }) } else { Ok(images) }
}

/// The image taken at a time.
fn nearest(images: &[ListedImage], timestamp_ns: u64) -> Option<PathBuf> {
    let after = images.partition_point(|image| image.timestamp_ns < timestamp_ns);
    let candidates = images[after.saturating_sub(1)..].iter().take(2);
    let nearest = candidates.min_by_key(|image| image.timestamp_ns.abs_diff(timestamp_ns))?;
    (nearest.timestamp_ns.abs_diff(timestamp_ns) <= MAX_PAIR_NS).then(|| nearest.path.clone())
}

/// The camera's poses, from a table of the body's; `path` is named in errors.
pub(super) fn parse_truth(text: &str, path: &Path, body_from_camera: &Se3) -> Result<Trajectory, SequenceError> {
    let mut poses = Vec::new();
    for row in parse_rows(text, path)? {
        let numbers: Vec<f64> = row.fields.iter().take(7).map_while(|field| field.parse().ok()).collect();
        let &[x, y, z, qw, qx, qy, qz] = numbers.as_slice() else {
            return Err(syntax(path, row.line, "expected `timestamp [ns],x,y,z,qw,qx,qy,qz`".into()));
        };
        let world_from_body =
            checks::rigid_of_quaternion([x, y, z], [qw, qx, qy, qz]).map_err(|what| syntax(path, row.line, what))?;
        let timestamp_s = seconds(row.timestamp_ns);
        poses.push(StampedPose { timestamp_s, world_from_camera: world_from_body * body_from_camera });
    }
    Ok(Trajectory { poses })
}

/// A line of a table: its time and what follows it.
pub(super) struct Row {
    line: usize,
    timestamp_ns: u64,
    fields: Vec<String>,
}

/// The rows of a table with ascending times in its first column; `path` is named in errors.
pub(super) fn parse_rows(text: &str, path: &Path) -> Result<Vec<Row>, SequenceError> {
    let mut rows: Vec<Row> = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let line_number = index + 1;
        let mut fields = line.split(',').map(|field| field.trim().to_owned());
        let time = fields.next().unwrap_or_default();
        let timestamp_ns =
            time.parse().map_err(|_| syntax(path, line_number, format!("`{time}` is not a timestamp in nanoseconds")))?;
        if rows.last().is_some_and(|last| timestamp_ns <= last.timestamp_ns) {
            return Err(syntax(path, line_number, format!("the timestamp {time} is not after the one before it")));
        }
        rows.push(Row { line: line_number, timestamp_ns, fields: fields.collect() });
    }
    Ok(rows)
}

fn seconds(timestamp_ns: u64) -> f64 {
    timestamp_ns as f64 / 1e9
}

fn syntax(path: &Path, line: usize, what: String) -> SequenceError {
    SequenceError::Syntax { path: path.into(), line, what }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector2, Vector3};

    use super::*;
    use crate::sequence::SensorKind;

    /// The calibration that the datasets come with, cam0 and cam1: `T_BS` without its last row, intrinsics, distortion.
    const CAMERAS: [(&str, &str, &str); 2] = [
        (
            "0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975, 0.999557249008, 0.0149672133247, \
             0.025715529948, -0.064676986768, -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949",
            "458.654, 457.296, 367.215, 248.375",
            "-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05",
        ),
        (
            "0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556, 0.999598781151, 0.0130119051815, \
             0.0251588363115, 0.0453689425024, -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038",
            "457.587, 456.134, 379.999, 255.238",
            "-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05",
        ),
    ];

    fn sensor((pose, intrinsics, lens): (&str, &str, &str)) -> String {
        format!(
            "# General sensor definitions.\nsensor_type: camera\ncomment: made up\n\nT_BS:\n  cols: 4\n  rows: 4\n  \
             data: [{pose},\n         0.0, 0.0, 0.0, 1.0]\n\nrate_hz: 20\nresolution: [752, 480]\ncamera_model: pinhole\n\
             intrinsics: [{intrinsics}] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n\
             distortion_coefficients: [{lens}]\n"
        )
    }

    /// Three frames; the right camera lacks the middle one.
    fn recording() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (camera, times) in
            [("cam0", vec![1_000_000_000u64, 1_050_000_000, 1_100_000_000]), ("cam1", vec![1_000_000_000, 1_100_000_100])]
        {
            let data = folder.path().join("mav0").join(camera).join("data");
            std::fs::create_dir_all(&data).unwrap();
            let mut list = "#timestamp [ns],filename\r\n".to_owned();
            for time in times {
                // Brightness follows the column, so that remapping shows.
                image::GrayImage::from_fn(752, 480, |x, _| image::Luma([(x / 3) as u8]))
                    .save(data.join(format!("{time}.png")))
                    .unwrap();
                list += &format!("{time},{time}.png\r\n");
            }
            write(&folder, &format!("{camera}/data.csv"), &list);
            write(&folder, &format!("{camera}/sensor.yaml"), &sensor(CAMERAS[usize::from(camera == "cam1")]));
        }
        std::fs::create_dir(folder.path().join("mav0/state_groundtruth_estimate0")).unwrap();
        let truth = "#timestamp, p_RS_R_x [m]\n1000000000,1,2,3,0.5,0.5,0.5,0.5,0,0,0\n1005000000,1,2,3.5,1,0,0,0,0,0,0\n";
        write(&folder, "state_groundtruth_estimate0/data.csv", truth);
        folder
    }

    fn write(folder: &tempfile::TempDir, name: &str, text: &str) {
        std::fs::write(folder.path().join("mav0").join(name), text).unwrap();
    }

    fn open(folder: &tempfile::TempDir) -> Result<Sequence, String> {
        Sequence::open(folder.path(), None, None).map_err(|error| error.to_string())
    }

    /// OpenCV's rectification of the same calibration, as ORB-SLAM2 ships it: f 435.2, centre (367.5, 252.2), f·b 47.906.
    #[test]
    fn the_pair_is_rectified_as_others_do_it() {
        let sequence = open(&recording()).unwrap();
        let Sensor::Stereo { baseline_metres } = sequence.sensor else { panic!("{:?}", sequence.sensor) };
        assert!((baseline_metres - 47.906_39 / 435.204_7).abs() < 1e-4, "{baseline_metres}");
        let pinhole = sequence.camera.pinhole;
        assert!((pinhole.fx - 435.2).abs() < 10.0 && pinhole.fx == pinhole.fy, "{pinhole:?}");
        assert!((pinhole.cx - 367.5).abs() < 10.0 && (pinhole.cy - 252.2).abs() < 10.0, "{pinhole:?}");
        assert!(sequence.camera.distortion.is_zero());
        let has_right: Vec<bool> = sequence.entries.iter().map(|entry| entry.right.is_some()).collect();
        assert_eq!((sequence.layout, has_right), (crate::sequence::Layout::of(&LAYOUT), vec![true, false, true]));
        assert_eq!(sequence.entries[1].timestamp_s, 1.05);
    }

    /// A point's way through truth and rectified image ends where the raw calibration and the recorded image say.
    #[test]
    fn truth_and_images_belong_to_the_rectified_camera() {
        let folder = recording();
        let sequence = open(&folder).unwrap();
        let world_from_camera = sequence.groundtruth.as_ref().unwrap().poses[0].world_from_camera;
        let (raw, body_from_raw) =
            parse_sensor(&read_text(&folder.path().join("mav0/cam0/sensor.yaml")).unwrap(), folder.path()).unwrap();
        let world_from_body = checks::rigid_of_quaternion([1.0, 2.0, 3.0], [0.5; 4]).unwrap();
        let frame = sequence.load(0).unwrap();
        let mut mono = sequence.clone();
        mono.restrict_to(SensorKind::Mono).unwrap();
        assert_eq!(mono.load(0).unwrap().color, frame.color, "without its right image, the left one is still rectified");
        for (x, y) in [(-1.0, -0.4), (0.0, 0.0), (0.7, 0.5), (1.2, -0.7)] {
            let p_in_raw = Point3::from(Vector3::new(x, y, 2.0));
            let p_in_world = world_from_body * body_from_raw * p_in_raw;
            let rectified = sequence.camera.pinhole.project(&(world_from_camera.inverse() * p_in_world).coords).unwrap();
            let recorded: Vector2<f64> = raw.distort_pixel(&raw.pinhole.project(&p_in_raw.coords).unwrap());
            let seen = frame.color.get_pixel(rectified.x.round() as u32, rectified.y.round() as u32).0[0];
            assert!((f64::from(seen) * 3.0 + 1.0 - recorded.x).abs() < 4.0, "{seen} where {} was recorded", recorded.x / 3.0);
        }
        assert!(frame.right.is_some() && sequence.load(1).unwrap().right.is_none());
    }

    #[test]
    fn one_camera_alone_keeps_its_lens() {
        let folder = recording();
        std::fs::remove_dir_all(folder.path().join("mav0/cam1")).unwrap();
        let sequence = open(&folder).unwrap();
        assert_eq!((sequence.sensor, sequence.camera.distortion.k1), (Sensor::Mono, -0.28340811));
        assert_eq!(sequence.load(0).unwrap().color.get_pixel(600, 7).0[0], 200);
        // x of the body is the camera's y, backwards.
        let down = sequence.groundtruth.unwrap().poses[1].world_from_camera.rotation * Vector3::y();
        assert!((down - Vector3::new(-1.0, 0.0, 0.0)).norm() < 0.03);
    }

    #[test]
    fn faults_name_the_file_and_the_line() {
        let spoil = |name: &str, from: &str, to: &str| {
            let folder = recording();
            let text = std::fs::read_to_string(folder.path().join("mav0").join(name)).unwrap();
            assert!(text.contains(from));
            write(&folder, name, &text.replacen(from, to, 1));
            open(&folder).map(|_| ()).unwrap_err()
        };
        let refused = |message: String, part: &str| assert!(message.contains(part), "{message}");
        refused(spoil("cam0/data.csv", "1050000000,", "900000000,"), "cam0/data.csv:3: the timestamp 900000000 is not after");
        refused(spoil("cam0/data.csv", "1050000000,", "1.05,"), "data.csv:3: `1.05` is not a timestamp in nanoseconds");
        refused(spoil("cam1/data.csv", ",1100000100.png", ",no.png"), "cam1/data.csv:3: there is no file");
        refused(spoil("cam0/sensor.yaml", "radial-tangential", "equidistant"), "equidistant lenses");
        refused(spoil("cam0/sensor.yaml", "intrinsics: [458.654", "intrinsics: [x"), "cam0/sensor.yaml:14: ");
        refused(spoil("cam0/sensor.yaml", "intrinsics", "extrinsics"), "sensor.yaml");
        refused(spoil("cam0/sensor.yaml", "resolution: [", "resolution: &size ["), "sensor.yaml:12: anchors, aliases");
        refused(spoil("cam0/sensor.yaml", "[752, 480]", "[60000, 60000]"), "is 752x480, but the camera is 60000x60000");
        refused(spoil("cam1/sensor.yaml", "[752, 480]", "[480, 480]"), "different sizes");
        refused(spoil("cam1/sensor.yaml", "0.0125552670891", "0.5"), "T_BS: the first three columns are no rotation");
        refused(spoil("cam1/sensor.yaml", "0.0453689425024", "-0.1453689425024"), "not to the right");
        refused(spoil("state_groundtruth_estimate0/data.csv", "3.5,1,0,0,0,0,0,0", "3.5,1"), "data.csv:3: expected `timestamp");
        refused(spoil("state_groundtruth_estimate0/data.csv", "3.5,1,", "3.5,0,"), "data.csv:3: a pose needs");
        let elsewhere = "1000000000,1000000000.png\r\n1100000100,1100000100.png";
        refused(spoil("cam1/data.csv", elsewhere, "7,1000000000.png"), "of one recording");
    }
}
