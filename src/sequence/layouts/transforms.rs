//! Photos with known poses in a `transforms.json`, as NeRF's data, instant-ngp and nerfstudio have it.
//!
//! `frames` lists photos (`file_path`, with or without its extension) and their `transform_matrix`, camera to world, of OpenGL's camera: x
//! right, y up, z backward; ours has y down, z forward. The lens is `fl_x fl_y cx cy w h k1 k2 k3 p1 p2`, or `camera_angle_x` alone. A
//! frame's values replace those of the whole file. Principal points count from the image's corner, ours from the first pixel's centre. Frames stay in the
//! order of the file, the n-th listed one has the timestamp of n seconds. Up to half of the photos may be missing.
//!
//! After nerfstudio, `mask_path` is an image whose black pixels are ignored, and `depth_file_path` a 16-bit image in units of
//! `depth_unit_scale_factor`, a thousandth of the poses' unit by default. With one depth image the recording is RGB-D; frames without
//! depth are then as those of a sensor that measured nothing. `ply_file_path` is a cloud of points in the poses' world.
//!
//! Left out: fisheye lenses, which are refused.

mod lens;

use std::path::{Path, PathBuf};

use glam::Vec3;
use nalgebra::{UnitQuaternion, Vector3};
use serde::Deserialize;

use super::row::{LayoutRow, SAMPLE_SIZE, parse_text};
use crate::files::ply::Vertices;
use crate::geometry::{Camera, Se3, StampedPose, Trajectory};
use crate::sequence::{
    FrameEntry, KnownPoint, Sensor, Sequence, SequenceError, checks, existing, folder_name, parse_json, read_text,
};
use lens::Lens;

const FILE: &str = "transforms.json";
/// The unit of depth images in that of the poses: millimetres where these are metres.
const DEPTH_UNIT: f64 = 1e-3;
/// Values of `camera_model` whose lens is OpenCV's.
const KNOWN_MODELS: [&str; 6] = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
/// Endings of photos whose path leaves it out.
const ENDINGS: [&str; 4] = ["", ".png", ".jpg", ".jpeg"];

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "transforms",
    marker: "transforms.json",
    help: "`transforms.json` of NeRF, instant-ngp and nerfstudio: photos with known poses.",
    is_photos: true,
    takes_camera: false,
    recognise,
    open: |folder, _| open(folder),
    parse: |bytes| {
        parse_text(bytes, |text, path| {
            let what = |what| SequenceError::Content { path: path.into(), what };
            let cameras = |file: Transforms| file.photos.iter().try_for_each(|photo| file.camera(photo, SAMPLE_SIZE).map(drop));
            vec![Transforms::parse(text, path).and_then(|file| cameras(file).map_err(what))]
        })
    },
};

fn recognise(folder: &Path) -> bool {
    folder.join(FILE).is_file()
}

fn open(folder: &Path) -> Result<Sequence, SequenceError> {
    let path = folder.join(FILE);
    let content = |what: String| SequenceError::Content { path: path.clone(), what };
    let file = Transforms::parse(&read_text(&path)?, &path)?;
    let found = file.photos.iter().map(|photo| image_file(folder, &photo.file_path).ok_or_else(|| photo.file_path.clone()));
    let found = found.enumerate().map(|(index, color)| Ok((index, color?)));
    let (mut entries, mut poses) = (Vec::new(), Vec::new());
    for (index, color) in existing(&path, found.collect())? {
        let photo = &file.photos[index];
        let wrong = |what: String| content(format!("frame {index}, {}: {what}", photo.file_path));
        let beside = |name: &Option<String>| {
            let missing = |name: &str| wrong(format!("there is no {name}; copy the recording whole, or take its name out"));
            name.as_deref().map(|name| image_file(folder, name).ok_or_else(|| missing(name))).transpose()
        };
        let (mask, depth) = (beside(&photo.mask_path)?, beside(&photo.depth_file_path)?);
        // A photo that cannot be read is met again, and counted, when it is loaded.
        let size = if photo.lens.is_sized() { Some((0, 0)) } else { image::image_dimensions(&color).ok() };
        let camera = size.map(|size| file.camera(photo, size)).transpose().map_err(wrong)?;
        let timestamp_s = index as f64;
        entries.push(FrameEntry { timestamp_s, color, depth, mask, camera, ..FrameEntry::default() });
        poses.push(StampedPose { timestamp_s, world_from_camera: photo.world_from_camera });
    }
    if entries.is_empty() {
        return Err(SequenceError::Empty { path });
    }
    let unreadable = || content("not one of its photos can be read; check that the recording was copied whole".into());
    let camera = entries.iter().find_map(|entry: &FrameEntry| entry.camera).ok_or_else(unreadable)?;
    let sensor = if entries.iter().any(|entry| entry.depth.is_some()) { Sensor::Rgbd } else { Sensor::Mono };
    let groundtruth = Some(Trajectory { poses });
    let points = file.ply_file_path.map_or(Ok(Vec::new()), |name| read_points(&folder.join(name)))?;
    let sequence = Sequence { groundtruth, points, ..Sequence::new(folder_name(folder), &LAYOUT, camera, sensor, entries) };
    sequence.check_first_size()?;
    sequence.check_mask_and_depth_sizes()?;
    Ok(sequence)
}

/// Checked content of the file.
struct Transforms {
    /// Poses' units per unit of depth.
    depth_unit: f64,
    ply_file_path: Option<String>,
    photos: Vec<Photo>,
}

/// A listed photo; paths as they are written.
struct Photo {
    file_path: String,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    lens: Lens,
    world_from_camera: Se3,
}

impl Transforms {
    /// `path` is named in errors.
    fn parse(text: &str, path: &Path) -> Result<Self, SequenceError> {
        let content = |what: String| SequenceError::Content { path: path.into(), what };
        let file: TransformsFile = parse_json(text, path)?;
        file.check_model().map_err(content)?;
        let opengl_from_camera = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let photo = |(index, frame): (usize, ListedFrame)| {
            let ListedFrame { file_path, mask_path, depth_file_path, transform_matrix, lens } = frame;
            let world_from_opengl = checks::rigid(transform_matrix.as_flattened())
                .map_err(|what| content(format!("frame {index}, {file_path}: {what}")))?;
            let (world_from_camera, lens) = (world_from_opengl * opengl_from_camera, lens.or(&file.lens));
            Ok::<_, SequenceError>(Photo { file_path, mask_path, depth_file_path, lens, world_from_camera })
        };
        let depth_unit = file.depth_unit_scale_factor.unwrap_or(DEPTH_UNIT);
        let photos = file.frames.into_iter().enumerate().map(photo).collect::<Result<_, SequenceError>>()?;
        Ok(Self { depth_unit, ply_file_path: file.ply_file_path, photos })
    }

    /// The camera of a photo of that size, if its lens does not say its own.
    fn camera(&self, photo: &Photo, size: (u32, u32)) -> Result<Camera, String> {
        photo.lens.camera(size, 1.0 / self.depth_unit)
    }
}

/// The points of a PLY file. One that is not there is no reason to refuse the photos, whose points can be triangulated.
fn read_points(path: &Path) -> Result<Vec<KnownPoint>, SequenceError> {
    let bytes = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            tracing::warn!("{} names the points in {}, which is missing", FILE, path.display());
            return Ok(Vec::new());
        }
        read => read.map_err(|source| SequenceError::Read { path: path.into(), source })?,
    };
    let Vertices { positions, colors } =
        Vertices::parse(&bytes).map_err(|what| SequenceError::Content { path: path.into(), what })?;
    let point = |(position, color): (Vec3, [u8; 3])| KnownPoint { position: position.as_dvec3().to_array().into(), color };
    Ok(positions.into_iter().zip(colors).map(point).collect())
}

/// The image that a path means.
fn image_file(folder: &Path, file_path: &str) -> Option<PathBuf> {
    ENDINGS.iter().map(|ending| folder.join(format!("{file_path}{ending}"))).find(|path| path.is_file())
}

#[derive(Deserialize)]
struct TransformsFile {
    camera_model: Option<String>,
    #[serde(default)]
    is_fisheye: bool,
    #[serde(flatten)]
    lens: Lens,
    depth_unit_scale_factor: Option<f64>,
    ply_file_path: Option<String>,
    frames: Vec<ListedFrame>,
}

#[derive(Deserialize)]
struct ListedFrame {
    file_path: String,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    transform_matrix: [[f64; 4]; 4],
    #[serde(flatten)]
    lens: Lens,
}

impl TransformsFile {
    fn check_model(&self) -> Result<(), String> {
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        if !self.is_fisheye && KNOWN_MODELS.contains(&model) {
            return Ok(());
        }
        let fisheye = if self.is_fisheye { " fisheye" } else { "" };
        Err(format!("{model}{fisheye} cameras are not known here; undistort the photos first"))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::geometry::{Distortion, Pinhole};

    const LENS: &str = r#""fl_x": 10.0, "fl_y": 11.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6.0, "k1": 0.1, "p2": 0.02"#;
    /// Straight down from two metres up, with the image's top towards the world's y; then a step to the right.
    const FRAMES: &str = r#"[
        { "file_path": "./images/b.png", "sharpness": 3, "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]] },
        { "file_path": "images/a",
          "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,2],[0,0,0,1]] }]"#;

    fn recording(lens: &str, frames: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("images")).unwrap();
        image::RgbImage::new(8, 6).save(folder.path().join("images/b.png")).unwrap();
        image::RgbImage::new(8, 6).save(folder.path().join("images/a.jpg")).unwrap();
        let comma = if lens.is_empty() { "" } else { "," };
        std::fs::write(folder.path().join(FILE), format!("{{ {lens}{comma} \"aabb_scale\": 16,\n\"frames\": {frames} }}"))
            .unwrap();
        folder
    }

    fn open(lens: &str, frames: &str) -> Result<Sequence, String> {
        Sequence::open(recording(lens, frames).path(), None, None).map_err(|error| error.to_string())
    }

    #[test]
    fn photos_lens_and_poses_are_read() {
        let folder = recording(LENS, FRAMES);
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        assert_eq!((sequence.layout, sequence.sensor), (crate::sequence::Layout::of(&LAYOUT), Sensor::Mono));
        let pinhole = Pinhole { fx: 10.0, fy: 11.0, cx: 3.5, cy: 2.5, width: 8, height: 6 };
        assert_eq!(sequence.camera.pinhole, pinhole);
        assert_eq!(sequence.camera.distortion, Distortion { k1: 0.1, p2: 0.02, ..Distortion::default() });
        assert_eq!(sequence.load(1).unwrap().timestamp_s, 1.0);
        let poses = sequence.groundtruth.unwrap().poses;
        let on_floor = |i: usize, x: f64, y: f64| poses[i].world_from_camera * Point3::new(x, y, 2.0);
        // A point below the image's centre is towards -y of the world, as its top is towards +y.
        assert!((on_floor(0, 0.5, 1.0) - Point3::new(0.5, -1.0, 0.0)).norm() < 1e-12);
        assert!((on_floor(1, 0.0, 0.0) - Point3::new(1.0, 0.0, 0.0)).norm() < 1e-12);
    }

    /// The first frame has a mask and a depth image, in millimetres; the second has neither.
    fn with_mask_and_depth() -> String {
        FRAMES.replacen("\"sharpness\": 3", "\"mask_path\": \"masks/b.png\", \"depth_file_path\": \"depth/b.png\"", 1)
    }

    #[test]
    fn masks_and_depth_are_read() {
        let folder = recording(LENS, &with_mask_and_depth());
        let image = |name: &str| folder.path().join(name);
        ["masks", "depth"].iter().for_each(|name| std::fs::create_dir(image(name)).unwrap());
        let open = || Sequence::open(folder.path(), None, None).map_err(|error| error.to_string());
        assert!(open().unwrap_err().contains("frame 0, ./images/b.png: there is no masks/b.png"));
        image::GrayImage::from_fn(8, 6, |x, _| image::Luma([u8::from(x > 0)])).save(image("masks/b.png")).unwrap();
        assert!(open().unwrap_err().contains("frame 0, ./images/b.png: there is no depth/b.png"));
        let depth = image::ImageBuffer::from_fn(8, 6, |x, y| image::Luma([(1000 * x + y) as u16]));
        depth.save(image("depth/b.png")).unwrap();
        let sequence = open().unwrap();
        assert_eq!(sequence.sensor, Sensor::Rgbd);
        let frames = sequence.load_all(&[0, 1]).into_iter().map(Result::unwrap).collect::<Vec<_>>();
        assert_eq!(frames[0].depth.as_ref().unwrap().at(2, 3), Some(2.003));
        assert_eq!([0, 1].map(|x| frames[0].mask.as_ref().unwrap().get_pixel(x, 0).0[0]), [0, 1]);
        assert!(frames[1].depth.is_none() && frames[1].mask.is_none());
        image::GrayImage::new(8, 7).save(image("masks/b.png")).unwrap();
        let message = open().unwrap_err();
        assert!(message.contains("masks/b.png is 8x7, but the camera is 8x6"), "{message}");
    }

    #[test]
    fn points_are_read_where_the_file_names_them() {
        let folder = recording(&format!("{LENS}, \"ply_file_path\": \"sparse_pc.ply\""), FRAMES);
        let open = || Sequence::open(folder.path(), None, None).map_err(|error| error.to_string());
        assert!(open().unwrap().points.is_empty());
        let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                   property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n0.5 -1 2 255 0 7\n";
        let file = folder.path().join("sparse_pc.ply");
        std::fs::write(&file, ply).unwrap();
        assert_eq!(open().unwrap().points, [KnownPoint { position: Vector3::new(0.5, -1.0, 2.0), color: [255, 0, 7] }]);
        std::fs::write(&file, ply.replace("-1 2", "-1")).unwrap();
        let message = open().unwrap_err();
        assert!(message.contains("sparse_pc.ply") && message.contains("vertex 0 has 5 of 6 values"), "{message}");
    }

    #[test]
    fn the_file_may_say_the_unit_of_its_depth() {
        let unit = |factor: &str| open(&format!("{LENS}, \"depth_unit_scale_factor\": {factor}"), FRAMES);
        assert_eq!(unit("0.25").unwrap().camera.depth_units_per_metre, 4.0);
        assert!(unit("0").unwrap_err().contains("depth units"));
    }

    #[test]
    fn a_missing_photo_is_left_out_and_the_others_keep_their_times() {
        let sequence = open(LENS, &FRAMES.replace("images/b", "images/d")).unwrap();
        assert_eq!(sequence.entries.iter().map(|entry| entry.timestamp_s).collect::<Vec<_>>(), [1.0]);
        let poses = sequence.groundtruth.unwrap().poses;
        assert_eq!((poses.len(), poses[0].timestamp_s, poses[0].world_from_camera.translation.x), (1, 1.0, 1.0));
    }

    #[test]
    fn an_angle_is_a_lens_and_frames_may_carry_it() {
        let pinhole = open(r#""camera_angle_x": 1.5707963267948966"#, FRAMES).unwrap().camera.pinhole;
        assert!((pinhole.fx - 4.0).abs() < 1e-9 && pinhole.fy == pinhole.fx);
        assert_eq!((pinhole.cx, pinhole.cy, pinhole.width, pinhole.height), (3.5, 2.5, 8, 6));
        let each = FRAMES.replace("\"file_path\"", &format!("{LENS}, \"file_path\""));
        assert_eq!(open("", &each).unwrap().camera.pinhole.fy, 11.0);
    }

    /// What a frame leaves out is the file's, and sizes follow from the photos where nobody says them.
    #[test]
    fn each_frame_may_have_its_own_lens() {
        let other = FRAMES.replacen("\"images/a\"", "\"images/a\", \"fl_x\": 20.0, \"k1\": 0.3", 1);
        let sequence = open(LENS, &other).unwrap();
        let [first, second] = [0, 1].map(|i| *sequence.camera_of(i));
        assert!(!sequence.has_one_camera());
        assert_eq!((first.pinhole.fx, first.pinhole.fy, first.distortion.k1), (10.0, 11.0, 0.1));
        assert_eq!((second.pinhole.fx, second.pinhole.fy, second.pinhole.cx), (20.0, 20.0, 3.5));
        assert_eq!(second.distortion, Distortion { k1: 0.3, p2: 0.02, ..Distortion::default() });
        let folder = recording(r#""fl_x": 10.0"#, FRAMES);
        image::RgbImage::new(4, 12).save(folder.path().join("images/a.jpg")).unwrap();
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        assert_eq!((sequence.camera_of(0).pinhole.cx, sequence.camera_of(1).pinhole.cx), (3.5, 1.5));
        assert_eq!(sequence.load(1).unwrap().color.dimensions(), (4, 12));
    }

    #[test]
    fn faults_name_the_file_and_the_frame() {
        let refused = |lens: &str, frames: &str, part: &str| {
            let message = open(lens, frames).map(|_| ()).unwrap_err();
            assert!(message.contains("transforms.json") && message.contains(part), "{message}");
        };
        let both_gone = FRAMES.replace("images/a", "images/c").replace("images/b", "images/d");
        refused(LENS, &both_gone, "2 of 2 listed images are missing, among them ./images/d.png");
        refused(LENS, &FRAMES.replacen("[0,0,1,2]", "[0,0,3,2]", 1), "frame 0, ./images/b.png: the first three");
        refused(LENS, &FRAMES.replacen("[0,0,1,2]", "[0,0,1]", 1), "transforms.json:3: ");
        refused(LENS, "[]", "lists no frames");
        refused("", FRAMES, "neither fl_x nor camera_angle_x");
        refused(&LENS.replace("10.0", "-10.0"), FRAMES, "a camera needs");
        refused(&LENS.replace("6.0", "6.5"), FRAMES, "6.5 pixels are no size");
        refused(&format!("{LENS}, \"camera_model\": \"OPENCV_FISHEYE\""), FRAMES, "OPENCV_FISHEYE cameras");
        refused(&format!("{LENS}, \"is_fisheye\": true"), FRAMES, "fisheye cameras");
        assert!(open(&LENS.replace("\"w\": 8", "\"w\": 16"), FRAMES).unwrap_err().contains("is 8x6, but the camera is 16x6"));
    }
}
