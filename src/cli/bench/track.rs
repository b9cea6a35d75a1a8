//! `keysplat bench track`

use std::path::PathBuf;
use std::time::Instant;

use clap::{Args, ValueEnum};
use crossbeam::channel::bounded;
use keysplat::Config;
use keysplat::evaluation::{Alignment, evaluate_trajectory};
use keysplat::files::write_atomically;
use keysplat::geometry::Trajectory;
use keysplat::report::replays::{ReplayRow, distributions, draw, to_csv, to_markdown};
use keysplat::sequence::{SensorKind, Sequence};
use keysplat::synthetic::SceneConfig;
use keysplat::tracking::{FrontEnd, Tracker, TrackingConfig};
use miette::{IntoDiagnostic, miette};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};

use super::ablation::{Variant, parse_variant};
use super::sweep::{recording, scene};
use crate::cli::{Verbosity, generate, print, progress};

/// Frames extracted ahead.
const AHEAD: usize = 8;
/// The room that other seeds furnish anew.
const ROOM: &str = "room-noisy";
const FIRST_ROOM_SEED: u64 = 101;
const ROOM_FRAMES: usize = 150;

#[derive(Args)]
pub(super) struct TrackArgs {
    /// Recordings with ground truth, or names of synthetic scenes: demo, room-clean, room-noisy.
    sequences: Vec<String>,
    /// Folder for track.csv, track.md and track.svg.
    #[arg(short, long)]
    out: PathBuf,
    /// Synthetic rooms of differing furnishing, textures and shake, 150 frames each, beside the recordings; one distribution in all.
    #[arg(long, default_value_t = 0)]
    rooms: u64,
    /// Start frames, spread over the first half of a recording; each replay goes on to the end.
    #[arg(long, default_value_t = 10, value_parser = at_least_one)]
    starts: usize,
    /// Frames of a replay, at most.
    #[arg(long)]
    frames: Option<usize>,
    /// Directions of replay. Videos are replayed forwards only.
    #[arg(long, value_delimiter = ',', value_enum, default_value = "forwards,backwards")]
    direction: Vec<Direction>,
    /// Strides: of every N frames one is replayed.
    #[arg(long, value_delimiter = ',', default_values_t = [1usize, 2], value_parser = at_least_one)]
    every: Vec<usize>,
    /// Shares of frames that are missing, percent.
    #[arg(long, value_delimiter = ',', default_values_t = [0u32, 5, 10], value_parser = clap::value_parser!(u32).range(..100))]
    missing: Vec<u32>,
    /// Sensors of which the recording's data is used: all of it by default.
    #[arg(long, value_delimiter = ',', value_enum)]
    sensor: Vec<SensorKind>,
    /// A variant: its name and the settings in which it differs, e.g. "many: tracking.features=2000" (may be given again).
    #[arg(long = "variant", value_name = "NAME: KEY=VALUE …", value_parser = parse_variant)]
    variants: Vec<Variant>,
    /// Replays at the same time; their times are longer for it.
    #[arg(long, default_value_t = 1, value_parser = at_least_one)]
    jobs: usize,
}

fn at_least_one(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| *n > 0).ok_or_else(|| "it must be a number from 1 on".into())
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Direction {
    Forwards,
    Backwards,
}

/// One replay to be made.
struct Replay<'a> {
    sequence: &'a Sequence,
    name: &'a str,
    config: (&'a str, &'a TrackingConfig),
    start: usize,
    direction: Direction,
    every: usize,
    missing_percent: u32,
    most: usize,
}

pub(super) fn track(args: &TrackArgs, verbosity: Verbosity) -> miette::Result<()> {
    std::fs::create_dir_all(&args.out).into_diagnostic()?;
    let recordings = recordings(args, verbosity)?;
    let plain = [Variant { name: "default".into(), settings: Vec::new() }];
    let variants = if args.variants.is_empty() { &plain[..] } else { &args.variants };
    let config = |variant: &Variant| Ok(Config::default().with_settings(&variant.settings).into_diagnostic()?.tracking);
    let configs = variants.iter().map(config).collect::<miette::Result<Vec<_>>>()?;
    let configs: Vec<(&str, &TrackingConfig)> = variants.iter().map(|v| v.name.as_str()).zip(&configs).collect();
    let replays = replays(args, &recordings, &configs);
    let bar = progress::bar(verbosity, replays.len() as u64, "{wide_bar} {pos}/{len} replays  {msg}");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.jobs).build().into_diagnostic()?;
    let measure = |replay: &Replay<'_>| {
        let row = replay.measure();
        bar.inc(1);
        row
    };
    let rows = pool.install(|| replays.par_iter().map(measure).collect::<miette::Result<Vec<ReplayRow>>>())?;
    bar.finish_and_clear();
    let all = distributions(&rows);
    let table = to_markdown(&all);
    let svg = draw(&all).map_err(|error| miette!("cannot draw: {error}; please report this"))?;
    for (name, text) in [("track.csv", &to_csv(&rows)), ("track.md", &table), ("track.svg", &svg)] {
        write_atomically(&args.out.join(name), text.as_bytes()).into_diagnostic()?;
    }
    print(&table)
}

/// The recordings with their names; one for each sensor, where sensors are given.
fn recordings(args: &TrackArgs, verbosity: Verbosity) -> miette::Result<Vec<(String, Sequence)>> {
    let mut folders = Vec::new();
    for sequence in &args.sequences {
        folders.push(recording(sequence, &args.out, verbosity)?);
    }
    for seed in (FIRST_ROOM_SEED..).take(args.rooms as usize) {
        let scene = scene(ROOM)?;
        let folder = args.out.join("recordings").join(format!("{ROOM}-{seed}"));
        generate::render_if_changed(&SceneConfig { seed, frames: ROOM_FRAMES, ..scene }, &folder, verbosity)?;
        folders.push(("rooms".into(), folder));
    }
    if folders.is_empty() {
        return Err(miette!("nothing to replay: give recordings, or --rooms"));
    }
    let mut recordings = Vec::new();
    for (name, folder) in folders {
        let open = || Sequence::open(&folder, None, None).into_diagnostic();
        let whole = open()?;
        if whole.groundtruth.is_none() {
            return Err(miette!("{} has no ground truth to compare a trajectory with", folder.display()));
        }
        if args.sensor.is_empty() {
            recordings.push((name, whole));
            continue;
        }
        for &kind in &args.sensor {
            let mut restricted = open()?;
            restricted.restrict_to(kind).into_diagnostic()?;
            recordings.push((format!("{name} {kind}"), restricted));
        }
    }
    Ok(recordings)
}

fn replays<'a>(
    args: &TrackArgs,
    recordings: &'a [(String, Sequence)],
    configs: &[(&'a str, &'a TrackingConfig)],
) -> Vec<Replay<'a>> {
    let mut replays = Vec::new();
    for (name, sequence) in recordings {
        let directions = args.direction.iter().filter(|d| sequence.has_random_access() || **d == Direction::Forwards);
        for &direction in directions {
            for &every in &args.every {
                for &missing_percent in &args.missing {
                    for k in 0..args.starts {
                        let start = k * (sequence.entries.len() / 2) / args.starts;
                        let most = args.frames.unwrap_or(usize::MAX);
                        let replay = |&config| Replay { sequence, name, config, start, direction, every, missing_percent, most };
                        replays.extend(configs.iter().map(replay));
                    }
                }
            }
        }
    }
    replays
}

impl Replay<'_> {
    /// The frames, in the order of replay. Which are missing depends on the start alone, so that all settings see the same ones.
    fn frames(&self) -> Vec<usize> {
        let len = self.sequence.entries.len();
        let place = |i: usize| if self.direction == Direction::Backwards { len - 1 - i } else { i };
        let mut rng = fastrand::Rng::with_seed(self.start as u64);
        let chosen = (self.start..len).step_by(self.every).take(self.most);
        chosen.filter(|_| rng.u32(..100) >= self.missing_percent).map(place).collect()
    }

    fn measure(&self) -> miette::Result<ReplayRow> {
        let frames = self.frames();
        let (name, config) = self.config;
        let mut tracker = Tracker::new(self.sequence.camera, self.sequence.sensor, config).into_diagnostic()?;
        let front_end = FrontEnd::new(self.sequence.camera, self.sequence.sensor, config);
        let started = Instant::now();
        std::thread::scope(|scope| {
            let (sender, extracted) = bounded(AHEAD);
            let (frames, front_end) = (&frames, &front_end);
            scope.spawn(move || {
                let ahead = rayon::current_num_threads().min(AHEAD);
                // As in a run, a frame that cannot be read is passed over.
                self.sequence.read_ahead(
                    frames.iter().copied(),
                    ahead,
                    |frame| front_end.extract(&frame),
                    |_, loaded| {
                        let Ok(extracted) = loaded else { return true };
                        sender.send(extracted).is_ok()
                    },
                );
            });
            for frame in extracted {
                tracker.track_extracted(&frame.into_diagnostic()?, true).into_diagnostic()?;
            }
            tracker.finish().into_diagnostic()?;
            Ok::<_, miette::Report>(())
        })?;
        let ms_per_frame = 1e3 * started.elapsed().as_secs_f64() / frames.len().max(1) as f64;
        let mut poses: Vec<_> = tracker.trajectory().into_iter().map(|(_, pose)| pose).collect();
        poses.sort_by(|a, b| a.timestamp_s.total_cmp(&b.timestamp_s));
        let lost = frames.len() - poses.len();
        let alignment = Alignment::of(self.sequence.sensor.kind());
        let truth = self.sequence.groundtruth.as_ref().expect("checked when it was opened");
        let errors = evaluate_trajectory(truth, &Trajectory { poses }, alignment);
        Ok(ReplayRow {
            recording: self.name.into(),
            variant: name.into(),
            start: self.start,
            backwards: self.direction == Direction::Backwards,
            every: self.every,
            missing_percent: self.missing_percent,
            frames: frames.len(),
            lost,
            keyframes: tracker.keyframe_count(),
            ate_rmse_m: errors.ok().map(|errors| errors.ate_rmse_m),
            ms_per_frame,
        })
    }
}
