//! The real program from a recording to its outputs: what it writes, that the figures are true of what it wrote, that it repeats,
//! and how it ends when it is interrupted or a frame cannot be read.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::common::recording::{
    FIRST_ITERATIONS, FPS, FRAMES, HEIGHT, ITERATIONS_PER_KEYFRAME, WIDTH, change_line, color_file, copy_folder,
    copy_of_recording, finish, keysplat, metrics, recording, run_command, scratch, skipped_without_adapter, stamp, stamps,
    truncate,
};
use keysplat::config::Config;
use keysplat::evaluation::Metrics;
use keysplat::evaluation::metrics::ImageFigures;
use keysplat::export::MapFormat;
use keysplat::geometry::Trajectory;
use keysplat::mapping::MappingConfig;
use sha2::{Digest, Sha256};

/// A finished run of the whole recording, for all tests that only look at one.
fn finished_run() -> &'static Path {
    static OUT: OnceLock<PathBuf> = OnceLock::new();
    OUT.get_or_init(|| run("finished", recording(), &[]))
}

/// Runs into a folder of that name.
fn run(name: &str, recording: &Path, more: &[&str]) -> PathBuf {
    let out = scratch().join(name);
    finish(run_command(recording, &out, more)).succeeded();
    out
}

fn read(path: PathBuf) -> Vec<u8> {
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// The names in a folder.
fn names(folder: &Path) -> BTreeSet<String> {
    std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

fn set(names: &[&str]) -> BTreeSet<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// The frame that a timestamp belongs to.
fn frame_of(stamp: &str) -> usize {
    (stamp.parse::<f64>().unwrap() * FPS).round() as usize
}

fn assert_plausible(figures: Option<ImageFigures>, count: usize) {
    let figures = figures.unwrap();
    assert_eq!(figures.count, count as u64);
    assert!((19.0..60.0).contains(&figures.psnr_db.unwrap()), "{figures:?}");
    assert!((0.6..1.0).contains(&figures.ssim.unwrap()), "{figures:?}");
    assert!((0.0..0.2).contains(&figures.depth_l1_m.unwrap()), "{figures:?}");
}

#[test]
fn a_run_writes_everything() {
    if skipped_without_adapter() {
        return;
    }
    let out = finished_run();
    let files = ".lock comparison.json config.toml exposures.json history.json keyframes.txt map.ply metrics.json trajectory.svg \
                 trajectory.txt views";
    assert_eq!(names(out), set(&files.split(' ').collect::<Vec<_>>()));
    // Every 8th frame is held out; recorded and rendered stand side by side.
    assert_eq!(names(&out.join("views")), set(&["000007.png", "000015.png", "000023.png"]));
    let pair = image::open(out.join("views/000015.png")).unwrap().into_rgb8();
    let recorded = image::open(color_file(recording(), 15)).unwrap().into_rgb8();
    assert_eq!(pair.dimensions(), (2 * WIDTH, HEIGHT));
    let difference = |x0: u32| {
        let off = recorded.enumerate_pixels().map(|(x, y, p)| f64::from(p[1].abs_diff(pair.get_pixel(x0 + x, y)[1])));
        off.sum::<f64>() / f64::from(WIDTH * HEIGHT)
    };
    assert!(difference(0) < 0.5, "left is the recorded image, not {} levels off", difference(0));
    assert!((0.5..25.0).contains(&difference(WIDTH)), "right is a render, {} levels off", difference(WIDTH));
    let every_frame: Vec<String> = (0..FRAMES).map(stamp).collect();
    assert_eq!(stamps(&out.join("trajectory.txt")), every_frame);
    let config = Config::read(&out.join("config.toml")).unwrap();
    assert_eq!(config.sequence.unwrap().path, recording());
}

#[test]
fn metrics_have_every_field_of_the_protocol() {
    if skipped_without_adapter() {
        return;
    }
    let json: serde_json::Value = serde_json::from_slice(&read(finished_run().join("metrics.json"))).unwrap();
    let numbers = "frames frames_read_failed frames_tracked keyframes ate_rmse_m.all_frames ate_rmse_m.keyframes \
        rpe.trans_m_per_frame rpe.rot_deg_per_frame gaussians map_bytes wall_s tracking_ms.median tracking_ms.p95 tracking_ms.max \
        mapping.iterations mapping.iterations_per_frame mapping.ms_per_iteration.median mapping.ms_per_iteration.p95 \
        mapping.map_width mapping.map_height peak_gpu_bytes threads";
    let texts = "sequence sensor map_hash adapter.name adapter.backend adapter.kind adapter.driver version config_hash";
    let pointer = |path: &str| format!("/{}", path.replace('.', "/"));
    let images = ["held_out", "all_frames", "monogs"]
        .into_iter()
        .flat_map(|protocol| ["count", "psnr_db", "ssim", "depth_l1_m"].map(|field| format!("images.{protocol}.{field}")));
    for path in numbers.split_whitespace().map(str::to_owned).chain(images) {
        assert!(json.pointer(&pointer(&path)).is_some_and(serde_json::Value::is_number), "{path}");
    }
    for path in texts.split_whitespace() {
        assert!(json.pointer(&pointer(path)).is_some_and(serde_json::Value::is_string), "{path}");
    }
    // What some systems do not tell is null there.
    for path in ["peak_host_bytes", "cpu"] {
        assert!(json.get(path).is_some(), "{path}");
    }
    assert_eq!(json["paced"], serde_json::Value::Bool(false));
}

#[test]
fn figures_are_true_of_what_was_written() {
    if skipped_without_adapter() {
        return;
    }
    let out = finished_run();
    let m = metrics(out);
    let keyframes: BTreeSet<usize> = stamps(&out.join("keyframes.txt")).iter().map(|stamp| frame_of(stamp)).collect();
    assert_eq!((m.frames, m.frames_tracked, m.frames_read_failed, m.frames_late), (FRAMES as u64, FRAMES as u64, 0, 0));
    assert_eq!(m.keyframes, Some(keyframes.len() as u64));
    assert!(keyframes.len() >= 2 && keyframes.contains(&0) && keyframes.iter().all(|index| index % 8 != 7));
    for ate in [m.ate_rmse_m.all_frames, m.ate_rmse_m.keyframes] {
        assert!((1e-5..0.03).contains(&ate.unwrap()), "{ate:?}");
    }
    assert!(m.rpe.trans_m_per_frame.unwrap() < 0.04 && m.rpe.rot_deg_per_frame.unwrap() < 1.0, "{:?}", m.rpe);

    assert_plausible(m.images.held_out, 3);
    assert_plausible(m.images.all_frames, FRAMES);
    assert_plausible(m.images.monogs, (0..FRAMES).filter(|index| index % 5 == 0 && !keyframes.contains(index)).count());

    let map = read(out.join("map.ply"));
    let cloud = MapFormat::default().read(&out.join("map.ply")).unwrap();
    assert_eq!((m.map_bytes, m.map_hash), (Some(map.len() as u64), Some(sha256(&map))));
    assert_eq!(m.gaussians, Some(cloud.len() as u64));
    assert!(cloud.len() > 1000 && cloud.first_non_finite().is_none());

    let mapping = m.mapping.unwrap();
    let refine = MappingConfig::default().refine;
    let consolidation = (refine.steps_per_keyframe + refine.final_epochs) * keyframes.len();
    let window = FIRST_ITERATIONS + ITERATIONS_PER_KEYFRAME * (keyframes.len() as u64 - 1);
    assert_eq!(mapping.iterations, window + consolidation as u64);
    assert_eq!(mapping.iterations_per_frame, mapping.iterations as f64 / FRAMES as f64);
    assert_eq!((mapping.map_width, mapping.map_height), (WIDTH, HEIGHT));
    let (step, tracking) = (mapping.ms_per_iteration.unwrap(), m.tracking_ms.unwrap());
    assert!(0.0 < step.median && step.median <= step.p95);
    assert!(0.0 < tracking.median && tracking.median <= tracking.p95 && tracking.p95 <= tracking.max);
    assert!(m.wall_s.unwrap() * 1e3 > step.median && m.peak_gpu_bytes.unwrap() > map.len() as u64);
    let config = Config::read(&out.join("config.toml")).unwrap();
    assert_eq!(m.config_hash, Some(sha256(config.identity().as_bytes())));
    assert_eq!(m.version, env!("CARGO_PKG_VERSION"));
}

/// Everything that a run decides is the same in both folders.
fn assert_same_run(a: &Path, b: &Path) {
    for file in ["trajectory.txt", "keyframes.txt", "map.ply", "config.toml", "views/000007.png"] {
        assert!(read(a.join(file)) == read(b.join(file)), "{file} differs");
    }
    let decided = |out: &Path| {
        let Metrics { map_hash, config_hash, ate_rmse_m, rpe, images, gaussians, .. } = metrics(out);
        (map_hash, config_hash, ate_rmse_m, rpe, images, gaussians)
    };
    assert_eq!(decided(a), decided(b));
}

#[test]
fn a_run_repeats_to_the_byte() {
    if !skipped_without_adapter() {
        assert_same_run(&run("repeated", recording(), &[]), finished_run());
    }
}

#[test]
fn the_written_configuration_runs_again() {
    if skipped_without_adapter() {
        return;
    }
    let again = scratch().join("from-config");
    let mut command = keysplat(["run", "--config"]);
    command.arg(finished_run().join("config.toml")).arg("--out").arg(&again);
    finish(command).succeeded();
    assert_same_run(&again, finished_run());
}

#[test]
fn frames_and_every_select() {
    if skipped_without_adapter() {
        return;
    }
    let out = run("selected", recording(), &["--frames", "4..15", "--every", "2"]);
    let chosen: Vec<String> = (4..15).step_by(2).map(stamp).collect();
    assert_eq!(stamps(&out.join("trajectory.txt")), chosen);
    assert_eq!(metrics(&out).frames, chosen.len() as u64);

    // A range without an end is written with the one it has.
    let out = run("selected", recording(), &["--frames", "20.."]);
    assert_eq!(stamps(&out.join("trajectory.txt")), (20..FRAMES).map(stamp).collect::<Vec<_>>());
    assert_eq!(Config::read(&out.join("config.toml")).unwrap().replay.frames, Some((20, FRAMES)));
}

#[test]
fn a_folder_that_is_used_again_keeps_nothing_of_the_earlier_run() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("used-again");
    copy_folder(finished_run(), &out);
    std::fs::write(out.join("views/mine.png"), b"not theirs").unwrap();
    run("used-again", recording(), &["--frames", "0..8"]);
    assert_eq!(names(&out.join("views")), set(&["000007.png", "mine.png"]));
    assert_eq!(metrics(&out).frames, 8);
}

#[test]
fn a_paced_run_counts_what_came_too_late() {
    if skipped_without_adapter() {
        return;
    }
    // Frames come a hundred times as fast as they were recorded: far too fast for any tracker.
    let hasty = copy_of_recording("hasty");
    for list in ["rgb.txt", "depth.txt", "groundtruth.txt"] {
        let text = std::fs::read_to_string(hasty.join(list)).unwrap();
        let faster = text.lines().map(|line| match line.split_once(' ') {
            Some((time, rest)) if !line.starts_with('#') => format!("{:.6} {rest}\n", time.parse::<f64>().unwrap() / 100.0),
            _ => format!("{line}\n"),
        });
        std::fs::write(hasty.join(list), faster.collect::<String>()).unwrap();
    }
    truncate(&color_file(&hasty, 2), 500);
    let out = run("paced", &hasty, &["--real-time"]);
    let m = metrics(&out);
    assert!(m.paced);
    assert_eq!((m.frames, m.frames_read_failed), (FRAMES as u64, 1));
    assert_eq!(m.frames_tracked, stamps(&out.join("trajectory.txt")).len() as u64);
    // What remains was given to the tracker and lost.
    let lost = m.frames.checked_sub(m.frames_tracked + m.frames_late + m.frames_read_failed);
    assert!(m.frames_tracked >= 1 && lost.is_some(), "{m:?}");
}

/// The preset measures a resolution that the adapter can afford, replays by timestamps, and maps as long as there is time.
#[test]
fn the_realtime_preset_maps_at_a_resolution_that_was_measured() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("realtime");
    let mut command = keysplat(["run", "--preset", "realtime"]);
    command.arg(recording()).arg("--out").arg(&out);
    let said = finish(command).succeeded();
    assert!(said.stderr.contains("training step measured"), "{}", said.stderr);
    let (m, config) = (metrics(&out), Config::read(&out.join("config.toml")).unwrap());
    let mapping = m.mapping.unwrap();
    assert!(m.paced && config.mapping.yields_to_keyframes && m.gaussians.unwrap() > 0, "{m}");
    assert_eq!(mapping.map_width, (f64::from(WIDTH) * config.map_scale).round() as u32);
    // Frames last as long as they did when they were recorded.
    assert!(m.wall_s.unwrap() >= (FRAMES - 1) as f64 / FPS, "{m}");
}

#[test]
fn an_unreadable_frame_is_counted_and_skipped() {
    if skipped_without_adapter() {
        return;
    }
    let spoilt = copy_of_recording("one-unreadable");
    let file = color_file(&spoilt, 10);
    truncate(&file, 2000);
    let out = scratch().join("one-unreadable-out");
    let finished = finish(run_command(&spoilt, &out, &[])).succeeded();
    assert!(finished.stderr.contains(file.to_str().unwrap()) && finished.stderr.contains("WARN"), "{}", finished.stderr);
    let m = metrics(&out);
    assert_eq!((m.frames, m.frames_read_failed, m.frames_tracked), (FRAMES as u64, 1, FRAMES as u64 - 1));
    let all_others: Vec<String> = (0..FRAMES).filter(|index| *index != 10).map(stamp).collect();
    assert_eq!(stamps(&out.join("trajectory.txt")), all_others);
}

/// Equal up to the nine decimals of the trajectory that is read back: they may carry a Gaussian over the bound of a depth key, and so past a neighbour
/// at nearly the same depth.
fn assert_close(a: Option<f64>, b: Option<f64>) {
    let (a, b) = (a.unwrap(), b.unwrap());
    assert!((a - b).abs() <= 5e-5 * b.abs(), "{a} is not {b}");
}

fn assert_same_images(a: Option<ImageFigures>, b: Option<ImageFigures>) {
    let (a, b) = (a.unwrap(), b.unwrap());
    assert_eq!(a.count, b.count);
    assert_close(a.psnr_db, b.psnr_db);
    assert_close(a.ssim, b.ssim);
    assert_close(a.depth_l1_m, b.depth_l1_m);
}

fn assert_same_errors(a: &Metrics, b: &Metrics) {
    assert_close(a.ate_rmse_m.all_frames, b.ate_rmse_m.all_frames);
    assert_close(a.rpe.trans_m_per_frame, b.rpe.trans_m_per_frame);
    assert_close(a.rpe.rot_deg_per_frame, b.rpe.rot_deg_per_frame);
    assert_same_images(a.images.held_out, b.images.held_out);
    assert_same_images(a.images.all_frames, b.images.all_frames);
    assert_eq!((a.gaussians, &a.map_hash, a.frames_tracked), (b.gaussians, &b.map_hash, b.frames_tracked));
}

#[test]
fn eval_finds_the_figures_of_the_run() {
    if skipped_without_adapter() {
        return;
    }
    let (ours, before) = (scratch().join("evaluated"), metrics(finished_run()));
    copy_folder(finished_run(), &ours);
    let said = finish(keysplat([Path::new("--log=json"), Path::new("eval"), &ours])).succeeded();
    let after = metrics(&ours);
    assert_eq!(serde_json::from_str::<Metrics>(&said.stdout).unwrap(), after);
    assert_same_errors(&after, &before);
    assert_close(after.ate_rmse_m.keyframes, before.ate_rmse_m.keyframes);
    assert_same_images(after.images.monogs, before.images.monogs);
    let untouched = |m: Metrics| (m.wall_s, m.tracking_ms, m.mapping, m.config_hash, m.keyframes, m.frames, m.adapter);
    assert_eq!(untouched(after), untouched(before));
    // It measures the files: a trajectory that is turned and moved fits the truth as well, but not the map.
    let file = ours.join("trajectory.txt");
    let mut moved = Trajectory::read_tum(&file).unwrap();
    moved.poses.iter_mut().for_each(|pose| pose.world_from_camera.translation.vector.x += 0.3);
    moved.write_tum(&file).unwrap();
    finish(keysplat([Path::new("eval"), &ours])).succeeded();
    let elsewhere = metrics(&ours);
    let psnr = |m: &Metrics| m.images.all_frames.unwrap().psnr_db.unwrap();
    assert!(psnr(&elsewhere) < psnr(&metrics(finished_run())) - 3.0);
}

#[test]
fn eval_measures_a_foreign_folder() {
    if skipped_without_adapter() {
        return;
    }
    let foreign = scratch().join("foreign");
    std::fs::create_dir_all(&foreign).unwrap();
    for file in ["trajectory.txt", "map.ply"] {
        std::fs::copy(finished_run().join(file), foreign.join(file)).unwrap();
    }
    finish(keysplat([Path::new("eval"), &foreign, Path::new("--sequence"), recording()])).succeeded();
    let (m, mut ours) = (metrics(&foreign), metrics(finished_run()));
    // Nothing there tells of exposures.
    ours.images.held_out = ours.images.held_out_map_colors.take();
    assert_same_errors(&m, &ours);
    assert_eq!((m.frames, m.keyframes, m.ate_rmse_m.keyframes, m.wall_s), (FRAMES as u64, None, None, None));
    assert_eq!(names(&foreign.join("views")), names(&finished_run().join("views")));
    // A comment and a blank line are nothing new to it.
    change_line(&foreign.join("trajectory.txt"), 1, |line| format!("# poses\n\n{line}"));
    finish(keysplat([Path::new("eval"), &foreign, Path::new("--sequence"), recording()])).succeeded();
    assert_same_errors(&metrics(&foreign), &ours);
}
