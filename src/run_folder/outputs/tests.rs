use image::Rgb;
use nalgebra::Vector3;

use super::*;
use crate::config::Config;
use crate::evaluation::views::ViewRecord;
use crate::geometry::StampedPose;
use crate::mapping::KeyframeReport;
use crate::run_folder::{FrameRecord, History, KeyframeRecord};
use crate::sequence::SensorKind;
use crate::splat::{Exposure, ShDegree};
use crate::synthetic::{self, CameraConfig, SceneConfig};
use crate::tracking::{KeyframePose, StageTimes};

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_folder_is_made_and_locked() {
    let parent = tempfile::tempdir().unwrap();
    let out = parent.path().join("new/run");
    let lock = prepare_folder(&out).unwrap();
    assert!(matches!(prepare_folder(&out), Err(OutputError::Busy { path }) if path == out));
    assert_eq!(names(&out), [".lock", "views"]);
    drop(lock);
    std::fs::write(out.join(".map.ply.123.partial"), b"half").unwrap();
    std::fs::write(out.join("views/.000123.png.123.partial"), b"half").unwrap();
    drop(prepare_folder(&out).unwrap());
    assert_eq!(names(&out), [".lock", "views"]);
    assert!(names(&out.join(VIEWS)).is_empty());
    std::fs::write(parent.path().join("file"), b"").unwrap();
    assert!(matches!(prepare_folder(&parent.path().join("file")), Err(OutputError::Folder { .. })));
}

#[test]
fn only_files_of_an_earlier_run_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let views = folder.path().join(VIEWS);
    remove_pictures(folder.path()).unwrap();
    std::fs::create_dir(&views).unwrap();
    for name in ["000007.png", "1234567.png", "12345.png", "notes.png", "00a007.png", "000007.jpg"] {
        std::fs::write(views.join(name), b"").unwrap();
    }
    remove_pictures(folder.path()).unwrap();
    assert_eq!(names(&views), ["000007.jpg", "00a007.png", "12345.png", "notes.png"]);
    remove_checkpoint(folder.path()).unwrap();
    std::fs::write(folder.path().join(CHECKPOINT), b"").unwrap();
    remove_checkpoint(folder.path()).unwrap();
    assert_eq!(names(folder.path()), [VIEWS]);
    // A folder cannot be removed as a file.
    std::fs::create_dir(folder.path().join(CHECKPOINT)).unwrap();
    assert!(matches!(remove_checkpoint(folder.path()), Err(OutputError::Remove { .. })));
}

fn view(frame: usize) -> ComparedView {
    let figures = ViewRecord { frame, psnr_db: None, ssim: 1.0, depth_l1_m: None };
    ComparedView { figures, recorded: RgbImage::new(1, 1), rendered: RgbImage::new(1, 1) }
}

#[test]
fn at_most_a_hundred_pictures_are_kept_spread_evenly() {
    for held_out in [0, 1, 5, 100, 101, 250, 1000] {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join(VIEWS)).unwrap();
        let pictures = Pictures::new(folder.path(), &(0..held_out).collect::<Vec<_>>());
        (0..held_out).for_each(|frame| pictures.add(&view(frame)));
        pictures.finish().unwrap();
        let gap = held_out.div_ceil(100).max(1);
        let kept: Vec<String> = (0..held_out).step_by(gap).map(picture_name).collect();
        assert!(kept.len() <= 100);
        assert_eq!(names(&folder.path().join(VIEWS)), kept, "of {held_out}");
    }
}

#[test]
fn no_picture_is_written_after_one_that_failed() {
    let folder = tempfile::tempdir().unwrap();
    let pictures = Pictures::new(folder.path(), &[0, 1, 2]);
    pictures.add(&view(0));
    std::fs::create_dir(folder.path().join(VIEWS)).unwrap();
    pictures.add(&view(1));
    let error = pictures.finish().unwrap_err().to_string();
    assert!(error.contains("000000.png"), "{error}");
    assert!(names(&folder.path().join(VIEWS)).is_empty());
}

#[test]
fn only_mono_is_aligned_by_a_similarity() {
    let sensors = [SensorKind::Mono, SensorKind::Stereo, SensorKind::Rgbd];
    assert_eq!(sensors.map(Alignment::of), [Alignment::Similarity, Alignment::Rigid, Alignment::Rigid]);
}

#[test]
fn a_picture_shows_the_recorded_view_left_and_the_rendered_one_right() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join(VIEWS)).unwrap();
    let filled = |color| RgbImage::from_pixel(5, 3, Rgb(color));
    let figures = ViewRecord { frame: 42, psnr_db: None, ssim: 1.0, depth_l1_m: None };
    write_picture(folder.path(), &ComparedView { figures, recorded: filled([200, 1, 2]), rendered: filled([3, 4, 150]) })
        .unwrap();
    let pair = image::open(folder.path().join(VIEWS).join("000042.png")).unwrap().to_rgb8();
    assert_eq!(pair.dimensions(), (10, 3));
    let colors = [pair.get_pixel(0, 0), pair.get_pixel(4, 2), pair.get_pixel(5, 0), pair.get_pixel(9, 2)].map(|p| p.0);
    assert_eq!(colors, [[200, 1, 2], [200, 1, 2], [3, 4, 150], [3, 4, 150]]);
}

fn pose(x: f64) -> Se3 {
    Se3::new(Vector3::new(x, 0.0, 0.0), Vector3::zeros())
}

/// Three tracked frames and two keyframes, the second of which was mapped.
fn result() -> RunResult {
    let stamped = |i: usize| StampedPose { timestamp_s: i as f64 / 10.0, world_from_camera: pose(i as f64) };
    let keyframe = |frame_index: usize| KeyframePose {
        frame_index,
        timestamp_s: frame_index as f64 / 10.0,
        world_from_camera: pose(frame_index as f64 + 0.5),
    };
    let report = KeyframeReport { id: 3, exposure: Exposure([0.1, 0.2, 0.3]), ..KeyframeReport::default() };
    let record = KeyframeRecord { report, done_s: 1.0, busy_s: 0.5, waiting: 0, host_bytes: None };
    RunResult {
        poses: vec![(0, stamped(0)), (2, stamped(2)), (3, stamped(3))],
        trajectory: Trajectory { poses: vec![stamped(0), stamped(2), stamped(3)] },
        keyframes: vec![keyframe(0), keyframe(3)],
        history: History {
            frames: vec![FrameRecord { frame: 0, lost: false, times: StageTimes::default() }],
            keyframes: vec![record],
            loops: vec![[1, 0]],
        },
        cloud: Arc::new(GaussianCloud::new(ShDegree::ALL[0])),
        ..RunResult::default()
    }
}

#[test]
fn a_result_gives_poses_by_frame_and_by_keyframe() {
    let result = result();
    assert_eq!(result.frame_poses(), [(0, pose(0.0)), (2, pose(2.0)), (3, pose(3.0))]);
    assert_eq!(result.keyframe_indices(), BTreeSet::from([0, 3]));
    let keyframes = result.keyframe_trajectory();
    assert_eq!(
        keyframes.poses.iter().map(|p| (p.timestamp_s, p.world_from_camera)).collect::<Vec<_>>(),
        [(0.0, pose(0.5)), (0.3, pose(3.5))]
    );
    let record = crate::evaluation::ExposureRecord { timestamp_s: 0.3, log_gain: Exposure([0.1, 0.2, 0.3]) };
    assert_eq!(result.exposures(), Exposures::new(vec![record]));
    let input = EvaluationInput::from(&result);
    assert_eq!((input.poses, input.keyframe_indices), (result.frame_poses(), result.keyframe_indices()));
    assert_eq!((input.trajectory, input.keyframes, input.exposures), (&result.trajectory, keyframes, result.exposures()));
}

#[test]
fn results_replace_those_of_an_earlier_run() {
    let folder = tempfile::tempdir().unwrap();
    let room = folder.path().join("room");
    let camera = CameraConfig { width: 32, height: 24, fx: 26.0, fy: 26.0, cx: 15.5, cy: 11.5, ..CameraConfig::default() };
    synthetic::generate(&SceneConfig { frames: 2, camera, ..SceneConfig::default() }, &room, &|_, _| {}).unwrap();
    let open = |exposure: bool| {
        let mut config = Config::for_recording(&room);
        config.mapping.exposure.enabled = exposure;
        Recording::open(config).unwrap()
    };
    let out = folder.path().join("out");
    std::fs::create_dir(&out).unwrap();
    std::fs::write(out.join(METRICS), b"of another map").unwrap();
    let (recording, result) = (open(true), result());
    let map = write_results(&out, &recording, &result).unwrap();
    assert_eq!(names(&out), [CONFIG, EXPOSURES, HISTORY, KEYFRAMES, "map.ply", TRAJECTORY]);
    let bytes = std::fs::read(out.join("map.ply")).unwrap();
    assert_eq!((map.bytes, map.hash), (bytes.len() as u64, sha256_hex(&bytes)));
    assert_eq!(Trajectory::read_tum(&out.join(TRAJECTORY)).unwrap().poses.len(), 3);
    assert_eq!(Trajectory::read_tum(&out.join(KEYFRAMES)).unwrap().poses.len(), 2);
    assert_eq!(&Config::read(&out.join(CONFIG)).unwrap(), recording.config());
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    assert_eq!(serde_json::from_str::<History>(&read(HISTORY)).unwrap(), result.history);
    assert_eq!(Exposures::parse(&read(EXPOSURES)).unwrap(), result.exposures());
    write_results(&out, &open(false), &result).unwrap();
    assert!(!out.join(EXPOSURES).exists());
}
