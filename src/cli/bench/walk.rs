//! `keysplat bench walk`

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use cpu_time::{ProcessTime, ThreadTime};
use keysplat::Config;
use keysplat::evaluation::{Alignment, evaluate_trajectory};
use keysplat::files::write_atomically;
use keysplat::geometry::{StampedPose, Trajectory};
use keysplat::tracking::{StageTimes, Tracker};
use keysplat::verification::walk::{Walk, World};
use miette::IntoDiagnostic;

use crate::cli::{Verbosity, print, progress};

/// A walk is reported in this many parts.
const PARTS: usize = 10;

#[derive(Args)]
pub(super) struct WalkArgs {
    /// What is walked through.
    #[arg(value_enum)]
    world: World,
    /// Frames of a walk.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(10..))]
    frames: u32,
    /// Walks through differing worlds.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// Settings by their keys in config.toml, e.g. tracking.keyframe_overlap=0.7 (may be given again).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Folder for walk.csv and walk.md.
    #[arg(short, long)]
    out: PathBuf,
}

/// A tenth of a walk.
#[derive(Default)]
struct Part {
    frames: usize,
    lost: usize,
    total_ms: f64,
    /// Processor time of all threads, but for making the frames.
    cpu_ms: f64,
    /// Processor time of making the frames: always the same work, hence how fast the machine was.
    making_ms: f64,
    longest_ms: f64,
    /// What it spent most of that on.
    longest_stage: &'static str,
    /// The most that the tracking thread computed for a frame: without waiting, whatever else the machine does.
    longest_own_ms: f64,
    /// Closed until its end.
    loops: usize,
    /// Of all frames until its end.
    ate_rmse_m: Option<f64>,
    keyframes: usize,
    living: usize,
    /// Of this process, bytes; 0 where the system does not say.
    memory: u64,
}

struct Outcome {
    parts: Vec<Part>,
    loops: usize,
    wrong_loops: usize,
    ate_rmse_m: Option<f64>,
}

pub(super) fn walk(args: &WalkArgs, verbosity: Verbosity) -> miette::Result<()> {
    std::fs::create_dir_all(&args.out).into_diagnostic()?;
    let bar = progress::bar(verbosity, args.seeds * u64::from(args.frames), "{wide_bar} {pos}/{len} frames  {msg}");
    let mut table = String::from(
        "| seed | frames | lost | keyframes | living | loops | wrong | ATE RMSE, cm | ms a frame | CPU | making | longest | own | memory, MB |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let mut csv = String::from(
        "seed,frame,lost,keyframes,living,loops,ate_rmse_cm,ms_per_frame,cpu_ms_per_frame,making_ms_per_frame,longest_ms,longest_stage,longest_own_ms,memory_bytes\n",
    );
    for seed in 0..args.seeds {
        let outcome = replay(args, seed, &bar)?;
        let Outcome { parts, loops, wrong_loops, ate_rmse_m } = &outcome;
        let mut frame = 0;
        for part in parts {
            frame += part.frames;
            let [ms, cpu, making] = [part.total_ms, part.cpu_ms, part.making_ms].map(|ms| ms / part.frames.max(1) as f64);
            let Part { lost, keyframes, living, loops, longest_ms, longest_stage, longest_own_ms: own, memory, .. } = part;
            let ate = centimetres(part.ate_rmse_m);
            csv += &format!(
                "{seed},{frame},{lost},{keyframes},{living},{loops},{ate},{ms:.3},{cpu:.3},{making:.3},{longest_ms:.2},{longest_stage},{own:.2},{memory}\n"
            );
            if args.seeds == 1 {
                let megabytes = memory >> 20;
                table += &format!(
                    "| | {frame} | {lost} | {keyframes} | {living} | {loops} | | {ate} | {ms:.2} | {cpu:.2} | {making:.2} | {longest_ms:.1} ({longest_stage}) | {own:.1} | {megabytes} |\n"
                );
            }
        }
        let last = parts.last().map_or((0, 0, 0), |p| (p.keyframes, p.living, p.memory >> 20));
        let lost: usize = parts.iter().map(|p| p.lost).sum();
        let a_frame = |ms: fn(&Part) -> f64| parts.iter().map(ms).sum::<f64>() / frame.max(1) as f64;
        let (ms, cpu, making) = (a_frame(|p| p.total_ms), a_frame(|p| p.cpu_ms), a_frame(|p| p.making_ms));
        let longest = parts.iter().map(|p| p.longest_ms).fold(0.0, f64::max);
        let own = parts.iter().map(|p| p.longest_own_ms).fold(0.0, f64::max);
        let ate = centimetres(*ate_rmse_m);
        let (keyframes, living, memory) = last;
        table += &format!(
            "| {seed} | {frame} | {lost} | {keyframes} | {living} | {loops} | {wrong_loops} | {ate} | {ms:.2} | {cpu:.2} | {making:.2} | {longest:.1} | {own:.1} | {memory} |\n"
        );
    }
    bar.finish_and_clear();
    for (name, text) in [("walk.csv", &csv), ("walk.md", &table)] {
        write_atomically(&args.out.join(name), text.as_bytes()).into_diagnostic()?;
    }
    print(&table)
}

fn replay(args: &WalkArgs, seed: u64, bar: &indicatif::ProgressBar) -> miette::Result<Outcome> {
    let config = Config::default().with_settings(&args.settings).into_diagnostic()?.tracking;
    let mut walk = Walk::new(args.world, seed, &config);
    let mut tracker = Tracker::new(Walk::camera(), args.world.sensor(), &config).into_diagnostic()?;
    let frames = args.frames as usize;
    let mut truth = Trajectory::default();
    let mut parts: Vec<Part> = (0..PARTS).map(|_| Part::default()).collect();
    let mut part_begins = ProcessTime::now();
    for i in 0..frames {
        let part = &mut parts[i * PARTS / frames];
        let making = ThreadTime::now();
        let (frame, world_from_camera) = walk.frame();
        part.making_ms += 1e3 * making.elapsed().as_secs_f64();
        truth.poses.push(StampedPose { timestamp_s: frame.timestamp_s(), world_from_camera });
        let (started, computing) = (Instant::now(), ThreadTime::now());
        let tracked = tracker.track_extracted(&frame, true).into_diagnostic()?;
        let (ms, own_ms) = (1e3 * started.elapsed().as_secs_f64(), 1e3 * computing.elapsed().as_secs_f64());
        part.frames += 1;
        part.lost += usize::from(tracked.world_from_camera.is_none());
        part.total_ms += ms;
        part.longest_own_ms = part.longest_own_ms.max(own_ms);
        if ms > part.longest_ms {
            (part.longest_ms, part.longest_stage) = (ms, longest_stage(&tracked.times));
        }
        (part.keyframes, part.living) = (tracker.keyframe_count(), tracker.living_keyframes());
        let ends_part = (i + 1) * PARTS / frames != i * PARTS / frames;
        if i % 100 == 0 || ends_part {
            part.memory = memory();
            bar.set_position(seed * frames as u64 + i as u64);
        }
        if ends_part {
            part.cpu_ms = 1e3 * part_begins.elapsed().as_secs_f64() - part.making_ms;
            (part.loops, part.ate_rmse_m) = (tracker.loops().len(), ate_rmse_m(&tracker, &truth));
            part_begins = ProcessTime::now();
        }
    }
    tracker.finish().into_diagnostic()?;
    let (loops, wrong_loops) = (tracker.loops().len(), args.world.wrong_loops(&tracker, &truth));
    Ok(Outcome { parts, loops, wrong_loops, ate_rmse_m: ate_rmse_m(&tracker, &truth) })
}

fn ate_rmse_m(tracker: &Tracker, truth: &Trajectory) -> Option<f64> {
    let poses = tracker.trajectory().into_iter().map(|(_, pose)| pose).collect();
    let errors = evaluate_trajectory(truth, &Trajectory { poses }, Alignment::Rigid);
    errors.ok().map(|errors| errors.ate_rmse_m)
}

fn centimetres(metres: Option<f64>) -> String {
    metres.map_or_else(|| "–".into(), |metres| format!("{:.2}", 100.0 * metres))
}

fn longest_stage(times: &StageTimes) -> &'static str {
    let stages = [
        (times.localise_ms, "localisation"),
        (times.mapping_ms, "map"),
        (times.bundle_ms, "bundle adjustment"),
        (times.loops_ms, "loops"),
    ];
    stages.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).map_or("", |(_, name)| name)
}

/// Resident memory of this process, bytes; 0 where the system does not say.
fn memory() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").ok();
    pages.and_then(|text| text.split(' ').nth(1)?.parse::<u64>().ok()).map_or(0, |pages| pages * 4096)
}
