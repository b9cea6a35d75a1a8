use nalgebra::{Point3, Vector2, Vector3};

use super::*;
use crate::sequence::KnownPoint;

const CAMERAS: &str = "# Camera list\n7 OPENCV 8 6 10 11 4.0 3.0 0.1 -0.2 0.003 0.004\n";
/// Not in the order of names, and with an image that observes nothing.
const IMAGES: &str = "# Image list\n# of two lines each\n\
    1 0.5 0.5 0.5 0.5 1 2 3 7 b c.png\n1.5 2.5 -1 3.5 4.5 9\n\
    2 1 0 0 0 0 0 4 7 a.png\n\n";
const POINTS: &str = "# Points\n9 1 -2 3.5 200 100 50 0.7 1 1\n10 0.5 0 -1 0 0 255 0.3\n";

/// Photos and a model in text.
fn recording() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(folder.path().join("images")).unwrap();
    std::fs::create_dir_all(folder.path().join("sparse/0")).unwrap();
    for name in ["a.png", "b c.png"] {
        image::RgbImage::new(8, 6).save(folder.path().join("images").join(name)).unwrap();
    }
    for (name, text) in [("cameras", CAMERAS), ("images", IMAGES), ("points3D", POINTS)] {
        std::fs::write(folder.path().join(format!("sparse/0/{name}.txt")), text).unwrap();
    }
    folder
}

/// The same model as binary files, put together by hand.
fn binary_files() -> [(&'static str, Vec<u8>); 3] {
    let count = |n: u64| n.to_le_bytes().to_vec();
    let numbers = |numbers: &[f64]| numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let pair = |a: u32, b: u32| [a.to_le_bytes(), b.to_le_bytes()].concat();
    let cameras = [count(1), pair(7, 4), count(8), count(6), numbers(&[10.0, 11.0, 4.0, 3.0, 0.1, -0.2, 0.003, 0.004])].concat();
    let image = |id: u32, pose: [f64; 7], name: &str, observations: Vec<u8>| {
        let name = [name.as_bytes(), &[0]].concat();
        [id.to_le_bytes().to_vec(), numbers(&pose), 7u32.to_le_bytes().to_vec(), name, observations].concat()
    };
    let seen = [count(2), numbers(&[1.5, 2.5]), count(u64::MAX), numbers(&[3.5, 4.5]), count(9)].concat();
    let images = [
        count(2),
        image(1, [0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0], "b c.png", seen),
        image(2, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0], "a.png", count(0)),
    ];
    let points = [
        [count(9), numbers(&[1.0, -2.0, 3.5]), vec![200, 100, 50], numbers(&[0.7]), count(1), pair(1, 1)].concat(),
        [count(10), numbers(&[0.5, 0.0, -1.0]), vec![0, 0, 255], numbers(&[0.3]), count(0)].concat(),
    ];
    [("cameras", cameras), ("images", images.concat()), ("points3D", [count(2), points.concat()].concat())]
}

fn binary_recording() -> tempfile::TempDir {
    let folder = recording();
    for (name, bytes) in binary_files() {
        std::fs::remove_file(folder.path().join(format!("sparse/0/{name}.txt"))).unwrap();
        std::fs::write(folder.path().join(format!("sparse/0/{name}.bin")), bytes).unwrap();
    }
    folder
}

fn error(folder: &tempfile::TempDir) -> String {
    Sequence::open(folder.path(), None, None).map(|_| ()).unwrap_err().to_string()
}

#[test]
fn both_forms_give_the_same_photos_poses_and_points() {
    for folder in [recording(), binary_recording()] {
        let mut sequence = Sequence::open(folder.path(), None, None).unwrap();
        assert_eq!((sequence.layout, sequence.sensor), (crate::sequence::Layout::named("colmap"), Sensor::Mono));
        let pinhole = Pinhole { fx: 10.0, fy: 11.0, cx: 3.5, cy: 2.5, width: 8, height: 6 };
        assert_eq!(sequence.camera.pinhole, pinhole);
        assert_eq!(sequence.camera.distortion, Distortion { k1: 0.1, k2: -0.2, p1: 0.003, p2: 0.004, k3: 0.0 });
        let names: Vec<_> = sequence.entries.iter().map(|entry| entry.color.file_name().unwrap().to_owned()).collect();
        assert_eq!(names, ["a.png", "b c.png"]);
        let expected = [([1.0, -2.0, 3.5], [200, 100, 50]), ([0.5, 0.0, -1.0], [0, 0, 255])];
        let expected = expected.map(|(position, color)| KnownPoint { position: Vector3::from(position), color });
        assert_eq!(sequence.points, expected);
        // The quaternion turns x into y, y into z, z into x.
        let poses = &sequence.groundtruth.as_ref().unwrap().poses;
        let centre = |i: usize| poses[i].world_from_camera * Point3::origin();
        assert!((centre(0) - Point3::new(0.0, 0.0, -4.0)).norm() < 1e-12);
        assert!((centre(1) - Point3::new(-2.0, -3.0, -1.0)).norm() < 1e-12);
        assert_eq!((poses[1].timestamp_s, sequence.entries[1].timestamp_s), (1.0, 1.0));
        sequence.select(Some(1..2), 1).unwrap();
        assert_eq!(sequence.load(0).unwrap().timestamp_s, 1.0);
    }
}

/// Photos of two cameras and sizes; the one that is first in the selection is the sequence's.
#[test]
fn each_photo_has_its_own_camera() {
    let folder = recording();
    let model = |name: &str| folder.path().join("sparse/0").join(name);
    std::fs::write(model("cameras.txt"), format!("{CAMERAS}9 PINHOLE 4 12 20 21 2 6\n")).unwrap();
    std::fs::write(model("images.txt"), IMAGES.replace("7 b c", "9 b c")).unwrap();
    image::RgbImage::new(4, 12).save(folder.path().join("images/b c.png")).unwrap();
    let mut sequence = Sequence::open(folder.path(), None, None).unwrap();
    assert!(!sequence.has_one_camera());
    assert_eq!([0, 1].map(|i| sequence.camera_of(i).pinhole.fx), [10.0, 20.0]);
    assert_eq!([0, 1].map(|i| sequence.load(i).unwrap().color.dimensions()), [(8, 6), (4, 12)]);
    sequence.select(Some(1..2), 1).unwrap();
    assert!(sequence.has_one_camera());
    assert_eq!((sequence.camera.pinhole.fx, sequence.camera_of(0).pinhole.fx), (20.0, 20.0));
}

#[test]
fn a_missing_photo_is_left_out_and_the_others_keep_their_times() {
    let folder = recording();
    std::fs::remove_file(folder.path().join("images/a.png")).unwrap();
    let sequence = Sequence::open(folder.path(), None, None).unwrap();
    let poses = sequence.groundtruth.unwrap().poses;
    assert_eq!((sequence.entries.len(), sequence.entries[0].timestamp_s), (1, 1.0));
    assert_eq!((poses.len(), poses[0].timestamp_s), (1, 1.0));
    assert!((poses[0].world_from_camera * Point3::origin() - Point3::new(-2.0, -3.0, -1.0)).norm() < 1e-12);
}

#[test]
fn lenses_are_read_or_refused_by_name() {
    let with = |line: &str| {
        let folder = recording();
        std::fs::write(folder.path().join("sparse/0/cameras.txt"), line).unwrap();
        Sequence::open(folder.path(), None, None).map(|sequence| sequence.camera).map_err(|error| error.to_string())
    };
    let simple = with("7 SIMPLE_RADIAL 8 6 10 4 3 0.1").unwrap();
    assert_eq!((simple.pinhole.fy, simple.distortion), (10.0, Distortion { k1: 0.1, ..Distortion::default() }));
    assert_eq!(with("7 RADIAL 8 6 10 4 3 0.1 0.2").unwrap().distortion.k2, 0.2);
    // The centre of an 8×6 image stays where it is.
    let centre = with("7 PINHOLE 8 6 10 12 4 3").unwrap().undistort_pixel(&Vector2::new(3.5, 2.5));
    assert_eq!(centre, Vector2::new(3.5, 2.5));
    assert_eq!(with("7 SIMPLE_PINHOLE 8 6 10 4 3").unwrap().pinhole.fy, 10.0);
    let refused = |line: &str, part: &str| {
        let message = with(line).unwrap_err();
        assert!(message.contains("cameras.txt") && message.contains(part), "{message}");
    };
    refused("7 FULL_OPENCV 8 6 10 10 4 3 0 0 0 0 0 0 0 0", "image_undistorter");
    refused("7 PINHOLE 8 6 10 4 3", "does not have 3 parameters");
    refused("7 PINHOLE 8 6 nan 10 4 3", "finite");
    refused("7 PINHOLE 80000 6 10 10 4 3", "80000 pixels");
    refused("1 PINHOLE 8 6 10 10 4 3", "no camera 7");
    refused("# none\n7 PINHOLE 8 six 10 10 4 3", "cameras.txt:2: `six` is no height");
    assert!(with("7 PINHOLE 16 12 10 10 4 3").unwrap_err().contains("is 8x6, but the camera is 16x12"));
}

#[test]
fn damaged_texts_are_refused_with_file_and_line() {
    let spoil = |name: &str, text: String| {
        let folder = recording();
        std::fs::write(folder.path().join("sparse/0").join(name), text).unwrap();
        error(&folder)
    };
    assert!(spoil("images.txt", IMAGES.replace("4 7 a", "x 7 a")).contains("images.txt:5: `x` is no pose"));
    assert!(spoil("images.txt", IMAGES.replace("1 0 0 0 0", "0 0 0 0 0")).contains("images.txt:5: a pose needs"));
    let both_gone = IMAGES.replace("7 a.png", "7 d.png").replace("b c.png", "b d.png");
    assert!(spoil("images.txt", both_gone).contains("images.txt: 2 of 2 listed images are missing, among them b d.png"));
    assert!(spoil("images.txt", IMAGES.replace("7 a.png", "8 a.png")).contains("cameras.txt: there is no camera 8"));
    assert!(spoil("images.txt", String::new()).contains("images.txt lists no frames"));
    assert!(spoil("points3D.txt", POINTS.replace("255", "256")).contains("points3D.txt:3: `256` is no colour"));
    assert!(spoil("points3D.txt", POINTS.replace("-2", "inf")).contains("points3D.txt:2: the position is not finite"));
}

/// Every cut of every file, and every count that lies, is an error that names the file.
#[test]
fn damaged_binaries_are_refused_without_believing_their_counts() {
    let folder = binary_recording();
    for (name, bytes) in binary_files() {
        let path = folder.path().join(format!("sparse/0/{name}.bin"));
        let refused = |spoilt: &[u8]| {
            std::fs::write(&path, spoilt).unwrap();
            let message = error(&folder);
            assert!(message.contains(&format!("{name}.bin")), "{message}");
        };
        (0..bytes.len()).for_each(|length| refused(&bytes[..length]));
        for count in [3, 1 << 40, u64::MAX] {
            refused(&[&count.to_le_bytes(), &bytes[8..]].concat());
        }
        // Any other byte may be wrong without being noticed, but does no harm.
        for at in 8..bytes.len() {
            let mut spoilt = bytes.clone();
            spoilt[at] ^= 0xff;
            std::fs::write(&path, &spoilt).unwrap();
            let _ = Sequence::open(folder.path(), None, None);
        }
        std::fs::write(&path, &bytes).unwrap();
    }
    let path = folder.path().join("sparse/0/cameras.bin");
    let [(_, mut cameras), ..] = binary_files();
    cameras[12] = 99;
    std::fs::write(path, cameras).unwrap();
    assert!(error(&folder).contains("no camera model 99"));
}
