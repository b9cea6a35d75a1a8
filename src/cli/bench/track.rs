//! `keysplat bench track`

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::{Args, ValueEnum};
use crossbeam::channel::bounded;
use keysplat::Config;
use keysplat::evaluation::{Alignment, evaluate_trajectory};
use keysplat::geometry::Trajectory;
use keysplat::jobs::{Draft, ReplayTask, Task, Work};
use keysplat::report::replays::{self as report, ReplayRow};
use keysplat::sequence::{SensorKind, Sequence};
use keysplat::synthetic::SceneConfig;
use keysplat::tracking::{FrontEnd, Tracker, TrackingConfig};
use miette::{IntoDiagnostic, miette};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};

use super::ablation::{Variant, parse_variant};
use super::sweep::{recordings, scene};
use crate::cli::{Verbosity, generate, jobs, print, progress};

/// Frames extracted ahead.
const AHEAD: usize = 8;
const FIRST_ROOM_SEED: u64 = 101;
const ROOM_FRAMES: usize = 150;

#[derive(Args)]
pub(super) struct TrackArgs {
    /// Recordings with ground truth, or names of synthetic scenes: demo, room-clean, room-noisy, room-stereo, hall-drive.
    sequences: Vec<String>,
    /// Folder for track.csv, track.md and track.svg.
    #[arg(short, long, required_unless_present = "plan")]
    out: Option<PathBuf>,
    /// Write a plan of tasks into this folder instead, for `keysplat jobs`.
    #[arg(long, value_name = "FOLDER", conflicts_with = "out")]
    plan: Option<PathBuf>,
    /// Synthetic rooms of differing furnishing, textures and shake, up to 150 frames each, beside the recordings; one distribution a scene.
    #[arg(long, default_value_t = 0)]
    rooms: u64,
    /// Scenes that `--rooms` furnishes anew, e.g. room-noisy, room-stereo, hall-drive.
    #[arg(long, value_name = "SCENE", value_delimiter = ',', default_value = "room-noisy")]
    scenes: Vec<String>,
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

/// A recording that is replayed, or the part of it that one sensor sees.
struct Source {
    name: String,
    path: PathBuf,
    sensor: Option<SensorKind>,
    sequence: Sequence,
}

/// One replay to be made.
struct Replay<'a> {
    sequence: &'a Sequence,
    config: &'a TrackingConfig,
    task: ReplayTask,
}

pub(super) fn track(args: &TrackArgs, verbosity: Verbosity) -> miette::Result<()> {
    let folder = args.plan.as_ref().or(args.out.as_ref()).ok_or_else(|| miette!("give a folder with --out or --plan"))?;
    std::fs::create_dir_all(folder).into_diagnostic()?;
    let sources = sources(args, folder, verbosity)?;
    let plain = [Variant { name: "default".into(), settings: Vec::new() }];
    let variants = if args.variants.is_empty() { &plain[..] } else { &args.variants };
    let configs = variants.iter().map(|variant| Ok((variant, config(&variant.settings)?))).collect::<miette::Result<Vec<_>>>()?;
    let replays = replays(args, &sources, &configs);
    if args.plan.is_some() {
        return plan(&replays, folder);
    }
    let bar = progress::bar(verbosity, replays.len() as u64, "{wide_bar} {pos}/{len} replays  {msg}");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.jobs).build().into_diagnostic()?;
    let measure = |replay: &Replay<'_>| {
        let row = replay.measure(&|| false)?;
        bar.inc(1);
        row.ok_or_else(|| miette!("a replay was interrupted"))
    };
    let rows = pool.install(|| replays.par_iter().map(measure).collect::<miette::Result<Vec<ReplayRow>>>())?;
    bar.finish_and_clear();
    print(&report::write(folder, &rows).into_diagnostic()?)
}

/// Writes the replays as tasks.
fn plan(replays: &[Replay<'_>], folder: &Path) -> miette::Result<()> {
    let mut draft = Draft::new(folder).into_diagnostic()?;
    for Replay { task, .. } in replays {
        let input = draft.input(&task.recording).into_diagnostic()?;
        let replay = ReplayTask { recording: draft.place(&task.recording).into_diagnostic()?, ..task.clone() };
        let direction = if task.backwards { "backwards" } else { "forwards" };
        let ReplayTask { name, variant, start, every, missing_percent, .. } = task;
        let name = format!("{name}, {variant}, from {start} {direction}, every {every}, {missing_percent}% missing");
        draft.task(Task { name, seed: *start as u64, inputs: vec![input], work: Work::Replay(replay) });
    }
    jobs::print_plan(&draft.finish().into_diagnostic()?)
}

/// Replays a task of a plan; `None` if `is_leaving` ended it early.
pub(in crate::cli) fn replay(task: &ReplayTask, is_leaving: &dyn Fn() -> bool) -> miette::Result<Option<ReplayRow>> {
    let sequence = open(&task.recording, task.sensor)?;
    Replay { sequence: &sequence, config: &config(&task.settings)?, task: task.clone() }.measure(is_leaving)
}

fn config(settings: &[String]) -> miette::Result<TrackingConfig> {
    Ok(Config::default().with_settings(settings).into_diagnostic()?.tracking)
}

fn open(folder: &Path, sensor: Option<SensorKind>) -> miette::Result<Sequence> {
    let mut sequence = Sequence::open(folder, None, None).into_diagnostic()?;
    if sequence.groundtruth.is_none() {
        return Err(miette!("{} has no ground truth to compare a trajectory with", folder.display()));
    }
    sensor.map_or(Ok(()), |kind| sequence.restrict_to(kind)).into_diagnostic()?;
    Ok(sequence)
}

/// The recordings with their names; one for each sensor, where sensors are given.
fn sources(args: &TrackArgs, out: &Path, verbosity: Verbosity) -> miette::Result<Vec<Source>> {
    let mut folders = recordings(&args.sequences, out, verbosity)?;
    for name in &args.scenes {
        let scene = scene(name)?;
        let frames = scene.frames.min(ROOM_FRAMES);
        for seed in (FIRST_ROOM_SEED..).take(args.rooms as usize) {
            let folder = out.join("recordings").join(format!("{name}-{seed}"));
            generate::render_if_changed(&SceneConfig { seed, frames, ..scene.clone() }, &folder, verbosity)?;
            folders.push((name.clone(), folder));
        }
    }
    if folders.is_empty() {
        return Err(miette!("nothing to replay: give recordings, or --rooms"));
    }
    let sensors: Vec<_> = if args.sensor.is_empty() { vec![None] } else { args.sensor.iter().copied().map(Some).collect() };
    let mut sources = Vec::new();
    for (name, path) in folders {
        for &sensor in &sensors {
            let name = sensor.map_or_else(|| name.clone(), |kind| format!("{name} {kind}"));
            sources.push(Source { name, sequence: open(&path, sensor)?, path: path.clone(), sensor });
        }
    }
    Ok(sources)
}

fn replays<'a>(args: &TrackArgs, sources: &'a [Source], configs: &'a [(&Variant, TrackingConfig)]) -> Vec<Replay<'a>> {
    let mut replays = Vec::new();
    for Source { name, path, sensor, sequence } in sources {
        let directions = args.direction.iter().filter(|d| sequence.has_random_access() || **d == Direction::Forwards);
        for &direction in directions {
            for &every in &args.every {
                for &missing_percent in &args.missing {
                    for k in 0..args.starts {
                        let replay = |(variant, config): &'a (&Variant, TrackingConfig)| {
                            let task = ReplayTask {
                                name: name.clone(),
                                recording: path.clone(),
                                sensor: *sensor,
                                variant: variant.name.clone(),
                                settings: variant.settings.clone(),
                                start: k * (sequence.entries.len() / 2) / args.starts,
                                backwards: direction == Direction::Backwards,
                                every,
                                missing_percent,
                                most: args.frames,
                            };
                            Replay { sequence, config, task }
                        };
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
        let (len, task) = (self.sequence.entries.len(), &self.task);
        let place = |i: usize| if task.backwards { len - 1 - i } else { i };
        let mut rng = fastrand::Rng::with_seed(task.start as u64);
        let chosen = (task.start..len).step_by(task.every).take(task.most.unwrap_or(usize::MAX));
        chosen.filter(|_| rng.u32(..100) >= task.missing_percent).map(place).collect()
    }

    /// The row; `None` if `is_leaving` ended the replay early.
    fn measure(&self, is_leaving: &dyn Fn() -> bool) -> miette::Result<Option<ReplayRow>> {
        let frames = self.frames();
        let config = self.config;
        let mut tracker = Tracker::new(self.sequence.camera, self.sequence.sensor, config).into_diagnostic()?;
        let front_end = FrontEnd::new(self.sequence.camera, self.sequence.sensor, config);
        let started = Instant::now();
        let times = std::thread::scope(|scope| {
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
                if is_leaving() {
                    return Ok(None);
                }
                tracker.track_extracted(&frame.into_diagnostic()?, true).into_diagnostic()?;
            }
            let tracked = started.elapsed();
            tracker.finish().into_diagnostic()?;
            Ok::<_, miette::Report>(Some((tracked, started.elapsed() - tracked)))
        })?;
        let Some((tracked, after)) = times else { return Ok(None) };
        let mut poses: Vec<_> = tracker.trajectory().into_iter().map(|(_, pose)| pose).collect();
        poses.sort_by(|a, b| a.timestamp_s.total_cmp(&b.timestamp_s));
        let lost = frames.len() - poses.len();
        let alignment = Alignment::of(self.sequence.sensor.kind());
        let truth = self.sequence.groundtruth.as_ref().expect("checked when it was opened");
        let errors = evaluate_trajectory(truth, &Trajectory { poses }, alignment);
        let ReplayTask { name, variant, start, backwards, every, missing_percent, .. } = self.task.clone();
        Ok(Some(ReplayRow {
            recording: name,
            variant,
            start,
            backwards,
            every,
            missing_percent,
            frames: frames.len(),
            lost,
            keyframes: tracker.keyframe_count(),
            ate_rmse_m: errors.ok().map(|errors| errors.ate_rmse_m),
            ms_per_frame: 1e3 * tracked.as_secs_f64() / frames.len().max(1) as f64,
            final_ms: 1e3 * after.as_secs_f64(),
        }))
    }
}
