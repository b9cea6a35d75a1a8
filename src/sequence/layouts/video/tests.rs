//! Videos that OpenCV itself writes, as Motion JPEG in AVI, which needs no codec from elsewhere.

use std::path::{Path, PathBuf};

use image::RgbImage;
use opencv::core::{Mat, MatTraitConst, Size};
use opencv::videoio::{VideoWriter, VideoWriterTrait};

use super::times;
use crate::sequence::{Layout, Sensor, SensorKind, Sequence};

const WIDTH: u32 = 96;
const HEIGHT: u32 = 64;
const FRAMES: usize = 20;
const FPS: f64 = 12.5;
const CAMERA: &str = "fps = 4.0\n[pinhole]\nfx = 80.0\nfy = 80.0\ncx = 47.5\ncy = 31.5\nwidth = 96\nheight = 64\n";

/// A gradient that moves on by a step each frame: smooth, so that the codec changes it little.
fn picture(frame: usize) -> RgbImage {
    let wave = |t: f64| (127.5 + 120.0 * (t / 15.0).sin()) as u8;
    RgbImage::from_fn(WIDTH, HEIGHT, |x, y| {
        let (x, y, t) = (f64::from(x), f64::from(y), frame as f64);
        image::Rgb([wave(x + 5.0 * t), wave(y - 3.0 * t), wave(x + y)])
    })
}

fn write_video(path: &Path, codec: [char; 4]) {
    let [a, b, c, d] = codec;
    let fourcc = VideoWriter::fourcc(a, b, c, d).unwrap();
    let size = Size::new(WIDTH as i32, HEIGHT as i32);
    let mut writer = VideoWriter::new(path.to_str().unwrap(), fourcc, FPS, size, true).unwrap();
    for frame in 0..FRAMES {
        let mut values = picture(frame).into_raw();
        values.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
        let bgr = Mat::from_slice(&values).unwrap();
        writer.write(&bgr.reshape(3, HEIGHT as i32).unwrap()).unwrap();
    }
    writer.release().unwrap();
}

/// A folder with `walk.avi` and its camera.
fn recording() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("camera.toml"), CAMERA).unwrap();
    let video = folder.path().join("walk.avi");
    write_video(&video, ['M', 'J', 'P', 'G']);
    (folder, video)
}

fn open(path: &Path) -> Sequence {
    Sequence::open(path, None, None).unwrap()
}

fn error(path: &Path) -> String {
    Sequence::open(path, None, None).map(|_| ()).unwrap_err().to_string()
}

fn mean_difference(a: &RgbImage, b: &RgbImage) -> f64 {
    let sum: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.as_raw().len() as f64
}

#[test]
fn frames_come_out_as_they_went_in_with_the_times_of_the_container() {
    let (folder, video) = recording();
    for path in [folder.path(), &video] {
        let sequence = open(path);
        assert_eq!((sequence.layout, sequence.sensor, sequence.name.as_str()), (Layout::named("video"), Sensor::Mono, "walk"));
        assert_eq!(sequence.entries.len(), FRAMES);
        for index in 0..FRAMES {
            let frame = sequence.load(index).unwrap();
            assert!((frame.timestamp_s - index as f64 / FPS).abs() < 1e-6, "{}", frame.timestamp_s);
            assert!(mean_difference(&frame.color, &picture(index)) < 4.0, "frame {index}");
            assert!(mean_difference(&frame.color, &picture(index + 1)) > 8.0, "frame {index} is not the next one");
        }
    }
}

#[test]
fn a_frame_is_the_same_in_whatever_order_it_is_loaded() {
    let (_folder, video) = recording();
    let sequence = open(&video);
    let in_order: Vec<RgbImage> = (0..FRAMES).map(|index| sequence.load(index).unwrap().color).collect();
    let mut rng = fastrand::Rng::with_seed(5);
    for _ in 0..3 * FRAMES {
        let index = rng.usize(..FRAMES);
        assert!(sequence.load(index).unwrap().color == in_order[index], "frame {index}");
    }
    let indices: Vec<usize> = (0..FRAMES).rev().collect();
    for (frame, index) in sequence.load_all(&indices).into_iter().zip(indices) {
        assert!(frame.unwrap().color == in_order[index], "frame {index}");
    }
    let mut part = sequence.clone();
    part.select(Some(3..15), 4).unwrap();
    part.restrict_to(SensorKind::Mono).unwrap();
    assert_eq!(part.entries.len(), 3);
    std::thread::scope(|scope| {
        for k in 0..3 {
            let (part, in_order) = (&part, &in_order);
            scope.spawn(move || assert!(part.load(k).unwrap().color == in_order[3 + 4 * k]));
        }
    });
}

#[test]
fn frames_behind_a_cut_are_unreadable_and_the_others_are_not() {
    let (_folder, video) = recording();
    let whole = open(&video);
    let bytes = std::fs::read(&video).unwrap();
    std::fs::write(&video, &bytes[..bytes.len() * 6 / 10]).unwrap();
    let cut = open(&video);
    assert_eq!(cut.entries.len(), FRAMES);
    assert!(cut.entries.windows(2).all(|pair| pair[0].timestamp_s < pair[1].timestamp_s));
    let readable = (0..FRAMES).take_while(|index| cut.load(*index).is_ok()).count();
    assert!((8..FRAMES - 4).contains(&readable), "{readable} frames");
    for index in readable..FRAMES {
        let message = cut.load(index).unwrap_err().to_string();
        assert!(message.contains(&format!("frame {index} of ")) && message.contains("walk.avi"), "{message}");
    }
    // The last one before the cut is half a picture.
    (0..readable - 1).for_each(|index| assert!(cut.load(index).unwrap().color == whole.load(index).unwrap().color));
    std::fs::write(&video, &bytes[..600]).unwrap();
    assert!(error(&video).contains("walk.avi: no frame can be decoded, the file ends too early"));
}

#[test]
fn what_is_no_video_or_has_no_camera_is_refused() {
    let (folder, video) = recording();
    let file = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.path().join(name), bytes).unwrap();
        folder.path().join(name)
    };
    let mut png = std::io::Cursor::new(Vec::new());
    picture(0).write_to(&mut png, image::ImageFormat::Png).unwrap();
    for path in [file("picture.mp4", png.get_ref()), file("text.mp4", b"not a video"), file("empty.mp4", b"")] {
        assert!(error(&path).contains("is no video that we know"), "{}", error(&path));
    }
    let unknown = file("unknown.mp4", b"\0\0\0\x10ftypisom\0\0\0\0\0\0\0\x08mdat");
    assert!(error(&unknown).contains("unknown.mp4: no frame can be decoded; play it"), "{}", error(&unknown));
    assert!(error(&folder.path().join("walks.avi")).contains("there is no folder or video"));
    assert!(error(folder.path()).contains("several videos"));
    let as_tum = Sequence::open(&video, Some(Layout::named("tum")), None).unwrap_err().to_string();
    assert!(as_tum.contains("there is no folder"), "{as_tum}");

    let camera = |text: &str| file("camera.toml", text.as_bytes());
    camera(&CAMERA.replace("height = 64", "height = 96"));
    assert!(error(&video).contains("walk.avi is 96x64, but the camera is 96x96"));
    camera(&format!("{CAMERA}[stereo]\nbaseline_metres = 0.1\n"));
    assert!(error(&video).contains("remove [stereo]"));
    camera("fps = ");
    assert!(error(&video).contains("camera.toml:1: "));
    let other = file("other.toml", CAMERA.as_bytes());
    assert!(Sequence::open(&video, None, other.to_str()).is_ok());
    let preset = Sequence::open(&video, None, Some("tum-fr1")).unwrap_err().to_string();
    assert!(preset.contains("but the camera is 640x480"), "{preset}");
    assert!(Sequence::open(&video, None, Some("other")).unwrap_err().to_string().contains("the path of a camera.toml"));
    assert!(Sequence::open(&video, None, Some("gone.toml")).unwrap_err().to_string().contains("cannot read gone.toml"));
    std::fs::remove_file(folder.path().join("camera.toml")).unwrap();
    assert!(error(&video).contains("no camera.toml beside this video"));
}

/// Images beside the video they were taken from stay what a folder of images is.
#[test]
fn images_go_before_a_video_unless_the_layout_is_named() {
    let (folder, _video) = recording();
    std::fs::create_dir(folder.path().join("rgb")).unwrap();
    picture(0).save(folder.path().join("rgb/0.png")).unwrap();
    let sequence = open(folder.path());
    assert_eq!((sequence.layout, sequence.entries.len()), (Layout::named("images"), 1));
    let sequence = Sequence::open(folder.path(), Some(Layout::named("video")), None).unwrap();
    assert_eq!((sequence.layout, sequence.entries.len()), (Layout::named("video"), FRAMES));
}

#[test]
fn times_that_do_not_increase_are_replaced_by_a_steady_rate() {
    assert_eq!(times(&[2.0, 2.25, 3.0], 0, 10.0), [0.0, 0.25, 1.0]);
    assert_eq!(times(&[2.0, 2.25], 2, 4.0), [0.0, 0.25, 0.5, 0.75]);
    // H.264 ends so, in OpenCV 4.6.
    assert_eq!(times(&[0.0, 0.5, 1.5, 0.0, 0.0], 1, 4.0), [0.0, 0.5, 1.5, 1.75, 2.0, 2.25]);
    for bad in [0.0, f64::NAN, f64::NEG_INFINITY] {
        for start in [vec![0.0, 5.0], vec![bad]] {
            let stamps: Vec<f64> = start.iter().copied().chain(std::iter::repeat_n(bad, 40)).collect();
            let steady: Vec<f64> = (0..stamps.len()).map(|i| -0.25 + (i + 1) as f64 / 4.0).collect();
            assert_eq!(times(&stamps, 0, 4.0), steady);
        }
    }
    assert!(times(&[], 0, 4.0).is_empty());
}

/// Phones write what the sensor saw and, beside it, how they were held.
#[test]
fn a_video_to_be_turned_is_left_as_it_was_filmed() {
    let folder = tempfile::tempdir().unwrap();
    let video = folder.path().join("walk.mov");
    write_video(&video, ['j', 'p', 'e', 'g']);
    let mut bytes = std::fs::read(&video).unwrap();
    // The matrix in the track's header (ISO/IEC 14496-12, 8.3.2): x' = height - y, y' = x, a quarter turn clockwise.
    let matrix = 44 + bytes.windows(4).position(|four| four == b"tkhd").unwrap();
    let turned: [u32; 9] = [0, 1 << 16, 0, (-1i32 << 16) as u32, 0, 0, HEIGHT << 16, 0, 1 << 30];
    bytes[matrix..matrix + 36].copy_from_slice(&turned.map(u32::to_be_bytes).concat());
    std::fs::write(&video, bytes).unwrap();
    std::fs::write(folder.path().join("camera.toml"), CAMERA).unwrap();
    let sequence = open(&video);
    for index in [0, 7] {
        assert!(mean_difference(&sequence.load(index).unwrap().color, &picture(index)) < 4.0, "frame {index}");
    }
    // Whoever calibrated it as players show it hears of that.
    let upright = CAMERA.replace("height = 64", "height = 96").replace("width = 96", "width = 64");
    std::fs::write(folder.path().join("camera.toml"), upright).unwrap();
    assert!(error(&video).contains("walk.mov: was filmed as 96x64"), "{}", error(&video));
}

/// Makes the frames from the eighth on last half as long, in a file whose index is at its end: one more row in the table of
/// durations (ISO/IEC 14496-12, 8.6.1.2), and all boxes around it that much longer.
fn speed_up(video: &Path) {
    let mut bytes = std::fs::read(video).unwrap();
    let number = |bytes: &[u8], at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    let mut at = 0;
    for name in [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"] {
        at += bytes[at..].windows(4).position(|four| four == name).unwrap();
        let length = number(&bytes, at - 4) + 8;
        bytes[at - 4..at].copy_from_slice(&length.to_be_bytes());
    }
    let duration = number(&bytes, at + 16);
    let rows = [2, 7, duration, FRAMES as u32 - 7, duration / 2].map(u32::to_be_bytes).concat();
    bytes.splice(at + 8..at + 20, rows);
    std::fs::write(video, bytes).unwrap();
}

#[test]
fn frames_at_no_steady_rate_keep_their_times() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("camera.toml"), CAMERA).unwrap();
    let video = folder.path().join("walk.mov");
    write_video(&video, ['j', 'p', 'e', 'g']);
    speed_up(&video);
    let sequence = open(&video);
    assert_eq!(sequence.entries.len(), FRAMES);
    for (index, entry) in sequence.entries.iter().enumerate() {
        let expected_s = (index as f64 - 0.5 * index.saturating_sub(7) as f64) / FPS;
        assert!((entry.timestamp_s - expected_s).abs() < 1e-6, "frame {index} at {} s", entry.timestamp_s);
    }
}
