//! Quality gate: short runs of the program on recordings, whose figures must stay as `tests/fixtures/quality.toml` has them.
//!
//! Worse by more than a figure's margin fails. Better by more fails too, until `make quality-fixture` has written the new figures.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::common::recording::{finish, keysplat, metrics, scratch, skipped_without_adapter};
use crate::common::requirements::recorded;
use keysplat::evaluation::Metrics;
use keysplat::synthetic::{self, CameraConfig, DegradationConfig, SceneConfig};
use serde::{Deserialize, Serialize};

const FIXTURE: &str = "tests/fixtures/quality.toml";
/// Set to write the fixture instead of comparing with it.
const UPDATE: &str = "KEYSPLAT_UPDATE_QUALITY";

/// Trajectory errors below this are rounding.
const ROUNDING_METRES: f64 = 1e-9;

/// What a run came to. `ate_m` is absent with known poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Figures {
    frames_tracked: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    ate_m: Option<f64>,
    psnr_db: f64,
    ssim: f64,
    gaussians: u64,
    steps: u64,
}

/// Largest accepted differences.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Margins {
    /// Share of the expected error, and metres on top of it.
    ate_share: f64,
    ate_m: f64,
    psnr_db: f64,
    ssim: f64,
    /// Shares of the expected counts.
    gaussians_share: f64,
    steps_share: f64,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fixture {
    version: String,
    adapter: String,
    margins: Margins,
    runs: BTreeMap<String, Figures>,
}

fn figures(m: &Metrics) -> Figures {
    let held_out = m.images.held_out.expect("views are held out");
    Figures {
        frames_tracked: m.frames_tracked,
        // Known poses differ from themselves by rounding alone.
        ate_m: m.ate_rmse_m.all_frames.filter(|ate| *ate > ROUNDING_METRES),
        psnr_db: held_out.psnr_db.expect("no view is equal to its render"),
        ssim: held_out.ssim.expect("views have a structure"),
        gaussians: m.gaussians.expect("there is a map"),
        steps: m.mapping.as_ref().expect("there were steps").iterations,
    }
}

/// A figure beyond its margin.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Change {
    Worse(&'static str),
    Better(&'static str),
    /// A count, which is neither better nor worse.
    Other(&'static str),
}

/// The figures that differ by more than their margins.
fn changes(expected: &Figures, found: &Figures, margins: &Margins) -> Vec<Change> {
    let mut changes = Vec::new();
    let mut quality = |name, gain: f64, margin: f64| {
        if gain > margin {
            changes.push(Change::Better(name));
        } else if gain.is_nan() || gain < -margin {
            changes.push(Change::Worse(name));
        }
    };
    quality("frames_tracked", found.frames_tracked as f64 - expected.frames_tracked as f64, 0.0);
    quality("psnr_db", found.psnr_db - expected.psnr_db, margins.psnr_db);
    quality("ssim", found.ssim - expected.ssim, margins.ssim);
    match (expected.ate_m, found.ate_m) {
        (Some(expected), Some(found)) => quality("ate_m", expected - found, margins.ate_share * expected + margins.ate_m),
        (None, None) => {}
        (Some(_), None) => quality("ate_m", f64::NAN, 0.0),
        (None, Some(_)) => quality("ate_m", f64::INFINITY, 0.0),
    }
    let mut count = |name, expected: u64, found: u64, share: f64| {
        if (found as f64 - expected as f64).abs() > share * expected as f64 {
            changes.push(Change::Other(name));
        }
    };
    count("gaussians", expected.gaussians, found.gaussians, margins.gaussians_share);
    count("steps", expected.steps, found.steps, margins.steps_share);
    changes
}

fn fixture_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(FIXTURE)
}

fn read_fixture() -> Fixture {
    let text = std::fs::read_to_string(fixture_path()).unwrap_or_else(|e| panic!("{FIXTURE}: {e}"));
    toml::from_str(&text).unwrap_or_else(|e| panic!("{FIXTURE}: {e}"))
}

/// Runs the program and holds its figures against the fixture's.
fn gate(name: &str, recording: &Path, options: &[&str]) {
    let out = scratch().join(name);
    let mut command = keysplat(["-q", "run"]);
    command.arg(recording).arg("--out").arg(&out).args(options);
    finish(command).succeeded();
    let m = metrics(&out);
    let found = figures(&m);
    let mut fixture = read_fixture();
    if std::env::var_os(UPDATE).is_some() {
        fixture.version = m.version;
        fixture.adapter = m.adapter.map_or_else(String::new, |a| a.name);
        fixture.runs.insert(name.into(), found);
        let text = std::fs::read_to_string(fixture_path()).unwrap();
        let comments: String = text.lines().take_while(|line| line.starts_with('#')).map(|line| format!("{line}\n")).collect();
        std::fs::write(fixture_path(), comments + &toml::to_string(&fixture).unwrap()).unwrap();
        return;
    }
    let expected = fixture.runs.get(name).unwrap_or_else(|| panic!("{FIXTURE} has no run `{name}`: make quality-fixture"));
    let changes = changes(expected, &found, &fixture.margins);
    let worse = changes.iter().any(|change| matches!(change, Change::Worse(_)));
    let advice = if worse { "find out why" } else { "if that is meant, run `make quality-fixture` and commit it" };
    assert!(changes.is_empty(), "{name}: {changes:?}\nexpected {expected:?}\nfound    {found:?}\n{advice}");
}

#[test]
fn rgbd_in_a_kitchen() {
    if let Some(kitchen) = recorded("redkitchen").filter(|_| !skipped_without_adapter()) {
        gate("rgbd-kitchen", &kitchen, &["--map-scale", "0.25", "--frames", "0..200"]);
    }
}

#[test]
fn mono_in_a_kitchen() {
    if let Some(kitchen) = recorded("redkitchen").filter(|_| !skipped_without_adapter()) {
        gate("mono-kitchen", &kitchen, &["--sensor", "mono", "--map-scale", "0.25", "--frames", "0..160"]);
    }
}

#[test]
fn stereo_on_a_road() {
    if let Some(kitti) = recorded("kitti-a").filter(|_| !skipped_without_adapter()) {
        gate("stereo-road", &kitti, &["--map-scale", "0.25"]);
    }
}

#[test]
fn photos_with_known_poses() {
    if let Some(bonsai) = recorded("bonsai").filter(|_| !skipped_without_adapter()) {
        let steps = ["--set", "mapping.refine.steps=600"];
        gate("photos", &bonsai, &[&["--known-poses", "--map-scale", "0.25", "--every", "6"], &steps[..]].concat());
    }
}

#[test]
fn a_synthetic_room() {
    if skipped_without_adapter() {
        return;
    }
    let camera = CameraConfig { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5, ..CameraConfig::default() };
    let degradation = DegradationConfig { image_noise: 2.0, depth_noise: 0.001, ..DegradationConfig::default() };
    let scene = SceneConfig { seed: 11, frames: 90, camera, degradation, ..SceneConfig::default() };
    let room = scratch().join("room");
    synthetic::generate(&scene, &room, &|_, _| {}).unwrap();
    gate("synthetic-room", &room, &["--map-scale", "0.5"]);
}

/// The gate itself: each figure that gets worse is noticed, so is each that gets better, and NaN is never good.
#[test]
fn the_gate_notices_each_change() {
    let margins = Margins { ate_share: 0.2, ate_m: 0.0005, psnr_db: 0.3, ssim: 0.01, gaussians_share: 0.1, steps_share: 0.05 };
    let expected = Figures { frames_tracked: 100, ate_m: Some(0.01), psnr_db: 28.0, ssim: 0.9, gaussians: 10_000, steps: 500 };
    let of = |change: &dyn Fn(&mut Figures)| {
        let mut found = expected.clone();
        change(&mut found);
        changes(&expected, &found, &margins)
    };
    assert_eq!(of(&|_| ()), []);
    assert_eq!(of(&|f| (f.psnr_db, f.ssim, f.ate_m, f.gaussians, f.steps) = (27.8, 0.895, Some(0.012), 10_900, 520)), []);
    assert_eq!(of(&|f| f.psnr_db = 27.6), [Change::Worse("psnr_db")]);
    assert_eq!(of(&|f| f.psnr_db = 28.4), [Change::Better("psnr_db")]);
    assert_eq!(of(&|f| f.psnr_db = f64::NAN), [Change::Worse("psnr_db")]);
    assert_eq!(of(&|f| f.ssim = 0.88), [Change::Worse("ssim")]);
    assert_eq!(of(&|f| f.ate_m = Some(0.0126)), [Change::Worse("ate_m")]);
    assert_eq!(of(&|f| f.ate_m = Some(0.007)), [Change::Better("ate_m")]);
    assert_eq!(of(&|f| f.ate_m = None), [Change::Worse("ate_m")]);
    assert_eq!(of(&|f| f.frames_tracked = 99), [Change::Worse("frames_tracked")]);
    assert_eq!(of(&|f| f.gaussians = 11_100), [Change::Other("gaussians")]);
    assert_eq!(of(&|f| f.steps = 470), [Change::Other("steps")]);
}
