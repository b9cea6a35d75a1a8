//! `keysplat calibrate`, and `keysplat run --camera auto`: the camera of a recording that comes without a calibration.

use std::path::{Path, PathBuf};

use clap::Args;
use keysplat::files::write_atomically;
use keysplat::geometry::{Camera, Distortion, Pinhole};
use keysplat::sequence::{ASSUMED_CAMERA, Layout, SensorKind, Sequence};
use keysplat::tracking::{FrontEnd, SelfCalibration, TrackingConfig, self_calibrate};
use miette::{IntoDiagnostic, miette};
use serde::Serialize;

use super::run::parse_range;
use super::{Verbosity, print, progress};

/// Frames that a calibration takes, where no range is given.
pub const FRAMES: usize = 600;
const AHEAD: usize = 8;
/// Depth images of most sensors count millimetres.
const USUAL_DEPTH_UNITS_PER_METRE: f64 = 1000.0;

#[derive(Args)]
pub struct CalibrateArgs {
    /// Folder of the recording, or a video.
    sequence: PathBuf,
    /// Layout of the recording, where it isn't recognised.
    #[arg(long, value_enum)]
    layout: Option<Layout>,
    /// Frames to calibrate by: a stretch on which the camera turns and moves. By default the first 600.
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    frames: Option<(usize, usize)>,
    /// File for the camera.
    #[arg(short, long, default_value = "camera.toml")]
    out: PathBuf,
}

/// A camera as its file has it.
#[derive(Serialize)]
struct CameraFile {
    fps: f64,
    /// With depth images that nothing else describes.
    depth_units_per_metre: Option<f64>,
    pinhole: Pinhole,
    distortion: Distortion,
}

pub fn calibrate(args: &CalibrateArgs, verbosity: Verbosity) -> miette::Result<()> {
    if args.out.exists() {
        return Err(miette!("{} exists; name another file with --out, or remove it", args.out.display()));
    }
    let found = find_camera(&args.sequence, args.layout, args.frames, &args.out, verbosity)?;
    if verbosity.quiet { Ok(()) } else { print(&format!("{}, in {}\n", describe(&found), args.out.display())) }
}

/// Finds the camera of a recording and writes its file.
pub fn find_camera(
    path: &Path,
    layout: Option<Layout>,
    range: Option<(usize, usize)>,
    out: &Path,
    verbosity: Verbosity,
) -> miette::Result<SelfCalibration> {
    let mut sequence = Sequence::open(path, layout, Some(ASSUMED_CAMERA)).into_diagnostic()?;
    sequence.restrict_to(SensorKind::Mono).into_diagnostic()?;
    let len = sequence.entries.len();
    let (start, end) = range.map_or((0, len.min(FRAMES)), |(start, end)| (start, end.min(len)));
    if start >= end {
        return Err(miette!("{} has {len} frames; give --frames within them", path.display()));
    }
    let Pinhole { width, height, .. } = sequence.camera.pinhole;
    let config = TrackingConfig::default();
    let front_end = FrontEnd::new(Camera::assumed(width, height), sequence.sensor, &config);
    let bar = progress::bar(verbosity, (end - start) as u64, "{wide_bar} {pos}/{len} frames read");
    let (mut frames, mut failed) = (Vec::new(), None);
    sequence.read_ahead(
        start..end,
        AHEAD,
        |frame| front_end.extract(&frame),
        |_, loaded| {
            bar.inc(1);
            match loaded {
                Ok(Ok(extracted)) => frames.push(extracted),
                Ok(Err(error)) => failed = Some(error),
                Err(error) => tracing::warn!("skipped, it cannot be read: {error}"),
            }
            failed.is_none()
        },
    );
    bar.finish_and_clear();
    failed.map_or(Ok(()), Err).into_diagnostic()?;
    let found = self_calibrate(&frames, (width, height), &config).into_diagnostic()?;
    tracing::info!("{}", describe(&found));
    let mut intervals: Vec<f64> = frames.windows(2).map(|pair| pair[1].timestamp_s() - pair[0].timestamp_s()).collect();
    intervals.sort_by(f64::total_cmp);
    let fps = intervals.get(intervals.len() / 2).filter(|s| **s > 0.0).map_or(30.0, |s| 1.0 / s);
    let has_depth = sequence.layout.name() == "images" && path.join("depth").is_dir();
    if has_depth {
        tracing::warn!(
            "the depth images are taken to be in millimetres; depth_units_per_metre in {} changes that",
            out.display()
        );
    }
    let depth_units_per_metre = has_depth.then_some(USUAL_DEPTH_UNITS_PER_METRE);
    let file = CameraFile { fps, depth_units_per_metre, pinhole: found.camera.pinhole, distortion: found.camera.distortion };
    let comment = format!("# Found by keysplat calibrate: {}.\n", describe(&found));
    write_atomically(out, (comment + &toml::to_string(&file).into_diagnostic()?).as_bytes()).into_diagnostic()?;
    Ok(found)
}

fn describe(found: &SelfCalibration) -> String {
    let SelfCalibration { camera, readout, focal_sigma, k1_sigma, keyframes, observations, rms_pixels } = found;
    let Distortion { k1, k2, p1, p2, .. } = camera.distortion;
    format!(
        "focal length {:.1} ± {focal_sigma:.1} pixels, k1 {k1:.4} ± {k1_sigma:.4}, k2 {k2:.4}, p1 {p1:.4}, p2 {p2:.4}, readout {readout:.2} of a \
         frame's time, from {observations} observations in {keyframes} keyframes with {rms_pixels:.2} pixels RMS",
        camera.pinhole.fx
    )
}
