//! What sensors and disks do in the middle of a run: it ends without panic or nonsense, says what is wrong, and keeps what was mapped.

use std::ffi::OsStr;
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::common::recording::{
    FPS, FRAMES, Finished, HEIGHT, WIDTH, color_file, copy_of_recording, finish, keysplat, metrics, run_command, scratch,
    skipped_without_adapter, stamp, stamps, truncate,
};
use image::{ImageBuffer, Luma, RgbImage};
use keysplat::evaluation::metrics::ImageFigures;
use keysplat::evaluation::{Exposures, Metrics};
use keysplat::export::MapFormat;
use keysplat::geometry::Trajectory;

/// The frames that are spoilt: in the middle, with held-out ones among them.
const SPOILT: Range<usize> = 9..17;

fn depth_file(recording: &Path, frame: usize) -> PathBuf {
    recording.join("depth").join(format!("{}.png", stamp(frame)))
}

fn set_depth(recording: &Path, frames: Range<usize>, units: u16) {
    frames.for_each(|frame| {
        ImageBuffer::from_pixel(WIDTH, HEIGHT, Luma([units])).save(depth_file(recording, frame)).unwrap();
    });
}

/// How a run of a spoilt copy went.
struct Run {
    said: Finished,
    metrics: Metrics,
    /// Frames with a pose.
    tracked: Vec<usize>,
}

impl Run {
    /// Runs a copy of the recording after `spoil` had it, and checks that all that it wrote is sound.
    fn of(name: &str, spoil: impl FnOnce(&Path), more: &[&str]) -> Self {
        let copy = copy_of_recording(name);
        spoil(&copy);
        let out = scratch().join(format!("{name}-out"));
        let said = finish(run_command(&copy, &out, more)).succeeded();
        assert!(!said.stderr.contains("panicked"), "{}", said.stderr);
        let cloud = MapFormat::default().read(&out.join("map.ply")).unwrap();
        assert!(cloud.first_non_finite().is_none());
        Trajectory::read_tum(&out.join("trajectory.txt")).unwrap();
        let all: Vec<String> = (0..FRAMES).map(stamp).collect();
        let tracked =
            stamps(&out.join("trajectory.txt")).iter().map(|stamp| all.iter().position(|s| s == stamp).unwrap()).collect();
        Self { said, metrics: metrics(&out), tracked }
    }

    /// Frames before and after what was spoilt have poses, and true ones.
    fn found_again(&self) -> &Self {
        let sound = (0..FRAMES).filter(|frame| !SPOILT.contains(frame));
        let lost: Vec<usize> = sound.filter(|frame| !self.tracked.contains(frame)).collect();
        assert!(lost.len() <= 1, "{lost:?} are lost, too: {}", self.said.stderr);
        self
    }

    /// The map is as good as usual.
    fn good_map(&self, psnr_db: f64) -> &Self {
        let found = self.metrics.images.held_out.unwrap().psnr_db.unwrap();
        assert!(found > psnr_db && self.metrics.gaussians.unwrap() > 1000, "{}", self.metrics);
        self
    }

    fn true_poses(&self, metres: f64) -> &Self {
        let ate = self.metrics.ate_rmse_m.all_frames.unwrap();
        assert!(ate < metres, "{ate} m: {}", self.metrics);
        self
    }
}

#[test]
fn frames_that_cannot_be_read() {
    if skipped_without_adapter() {
        return;
    }
    let run = Run::of(
        "unreadable",
        |copy| {
            SPOILT.for_each(|frame| truncate(&color_file(copy, frame), 700));
            truncate(&depth_file(copy, 20), 700);
        },
        &[],
    );
    run.good_map(19.0).true_poses(0.03);
    assert_eq!(run.metrics.frames_read_failed as usize, SPOILT.len() + 1);
    let copy = scratch().join("unreadable");
    for file in SPOILT.map(|frame| color_file(&copy, frame)).chain([depth_file(&copy, 20)]) {
        assert!(run.said.stderr.contains(file.to_str().unwrap()), "{}: {}", file.display(), run.said.stderr);
    }
}

#[test]
fn a_frozen_picture() {
    if skipped_without_adapter() {
        return;
    }
    let spoil = |copy: &Path| {
        for frame in SPOILT.skip(1) {
            std::fs::copy(color_file(copy, SPOILT.start), color_file(copy, frame)).unwrap();
            std::fs::copy(depth_file(copy, SPOILT.start), depth_file(copy, frame)).unwrap();
        }
    };
    // Half a second of it is where the camera is not; the error says so, and nothing else may.
    let run = Run::of("frozen", spoil, &[]);
    run.found_again().good_map(15.0).true_poses(0.2);
    assert_eq!(run.metrics.frames_read_failed, 0);
}

#[test]
fn black_pictures() {
    if skipped_without_adapter() {
        return;
    }
    let spoil = |copy: &Path| SPOILT.for_each(|frame| RgbImage::new(WIDTH, HEIGHT).save(color_file(copy, frame)).unwrap());
    let run = Run::of("black", spoil, &[]);
    run.found_again().good_map(19.0).true_poses(0.03);
    assert!(!run.tracked.iter().any(|frame| SPOILT.contains(frame)), "{:?}", run.tracked);
}

#[test]
fn a_camera_that_adapts() {
    if skipped_without_adapter() {
        return;
    }
    // Exposure and white balance: pictures darken, and redden, all the time.
    let gains = |frame: f64| [0.25, 0.4, 0.5].map(|rate: f64| (-rate * frame / FRAMES as f64).exp());
    let adapt = |copy: &Path| {
        for frame in 0..FRAMES {
            let mut picture = image::open(color_file(copy, frame)).unwrap().into_rgb8();
            let gains = gains(frame as f64);
            picture.pixels_mut().for_each(|p| p.0 = std::array::from_fn(|k| (f64::from(p.0[k]) * gains[k]).round() as u8));
            picture.save(color_file(copy, frame)).unwrap();
        }
    };
    let settings = ["mapping.first_iterations=60", "mapping.iterations_per_keyframe=20", "mapping.exposure.pull=0"];
    let settings: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
    let run = Run::of("adapting", adapt, &settings);
    run.good_map(19.0).true_poses(0.03);
    let out = scratch().join("adapting-out");
    let found = Exposures::parse(&std::fs::read_to_string(out.join("exposures.json")).unwrap()).unwrap();
    let halfway = found.at(0.5 * FRAMES as f64 / FPS).0.map(f64::from);
    let truth = gains(0.5 * FRAMES as f64).map(f64::ln);
    assert!((0..3).all(|k| (0.6..1.2).contains(&(halfway[k] / truth[k]))), "{halfway:?}, and not {truth:?}");
    let psnr_db = |figures: Option<ImageFigures>| figures.unwrap().psnr_db.unwrap();
    let images = &run.metrics.images;
    assert!(psnr_db(images.held_out) > psnr_db(images.held_out_map_colors) + 0.5, "{}", run.metrics);

    finish(keysplat([OsStr::new("eval"), out.as_os_str()])).succeeded();
    assert!((psnr_db(metrics(&out).images.held_out) - psnr_db(images.held_out)).abs() < 1e-3);
    std::fs::write(out.join("exposures.json"), "[1, 2]").unwrap();
    finish(keysplat([OsStr::new("eval"), out.as_os_str()])).refused(&["exposures.json does not hold exposures"]);
}

/// Nothing measured, and what sensors write where they measured nothing.
const NO_DEPTH: [(&str, u16); 2] = [("zero", 0), ("far", u16::MAX)];

#[test]
fn depth_that_fails_for_a_while() {
    if skipped_without_adapter() {
        return;
    }
    let known: &[&str] = &["--known-poses", "--set", "mapping.refine.steps=40", "--set", "mapping.refine.density_every=20"];
    for (way, more) in [("tracked", &[][..]), ("known", known)] {
        let maps = NO_DEPTH.map(|(name, units)| {
            let run = Run::of(&format!("{way}-{name}"), |copy| set_depth(copy, SPOILT, units), more);
            run.found_again().good_map(19.0).true_poses(0.03);
            run.metrics.map_hash
        });
        assert_eq!(maps[0], maps[1], "{way}: one is as good as the other");
    }
    // A wall that is not there: nothing says so, but tracking holds.
    let run = Run::of("wall", |copy| set_depth(copy, SPOILT, u16::MAX - 1), &[]);
    run.found_again().good_map(15.0).true_poses(0.03);
}

#[test]
fn depth_that_never_comes() {
    if skipped_without_adapter() {
        return;
    }
    for (name, units) in NO_DEPTH {
        let copy = copy_of_recording(&format!("no-depth-{name}"));
        set_depth(&copy, 0..FRAMES, units);
        let out = scratch().join(format!("no-depth-{name}-out"));
        let said = finish(run_command(&copy, &out, &[]));
        said.refused(&["not one frame could be tracked", "depth between tracking.min_depth_metres"]);
    }
}
