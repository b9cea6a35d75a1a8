//! `keysplat run`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;
use keysplat::config::{Config, SequenceConfig};
use keysplat::gpu::Gpu;
use keysplat::pipeline::{self, Budget, Checkpoint, Checkpoints, Outcome, PipelineError, Progress, outputs};
use keysplat::sequence::{Layout, Sensor, SensorKind, Sequence, is_camera_file};
use miette::{IntoDiagnostic, miette};

use super::{Verbosity, print_metrics, progress};

#[derive(Args)]
pub struct RunArgs {
    /// Folder of the recording, or a video; may also stand in the configuration.
    sequence: Option<PathBuf>,
    /// Folder for the results.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Configuration (TOML); options on the command line go before it.
    #[arg(short, long)]
    config: Option<PathBuf>,
    /// Layout of the recording, where it isn't recognised.
    #[arg(long, value_enum)]
    layout: Option<Layout>,
    /// Use of the recording only what a sensor of this kind gives.
    #[arg(long, value_enum)]
    sensor: Option<SensorKind>,
    /// Camera preset to use instead of the recording's own calibration; for a video, or the path of a camera.toml.
    #[arg(long)]
    camera: Option<String>,
    /// Mapping resolution as a share of the recorded one, e.g. 0.5.
    #[arg(long)]
    map_scale: Option<f64>,
    /// Replay every n-th frame.
    #[arg(long)]
    every: Option<usize>,
    /// Replay frames A..B only (B excluded; either may be left out).
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    frames: Option<(usize, usize)>,
    /// Let frames arrive by their timestamps and drop what comes too late.
    #[arg(long)]
    paced: bool,
    /// Track nothing: take the poses that the recording knows (COLMAP, transforms.json, ground truth), and refine the map over all
    /// keyframes after the last one.
    #[arg(long)]
    known_poses: bool,
    /// Part of the name of the adapter to use (see `keysplat adapters`).
    #[arg(long)]
    adapter: Option<String>,
    /// How much time the run may take; goes over the configuration file, and the other options over it.
    #[arg(long, value_enum)]
    budget: Option<BudgetName>,
    /// Most Gaussians that the map may have at any time; the least useful go first.
    #[arg(long)]
    max_gaussians: Option<usize>,
    /// Most GPU memory that the mapper may use, e.g. 500M or 2G.
    #[arg(long, value_parser = parse_bytes)]
    max_gpu_memory: Option<u64>,
    /// Keep a checkpoint after every so many keyframes (and rounds of a refinement), for `keysplat resume`.
    #[arg(long, value_name = "N")]
    checkpoint_every: Option<usize>,
    /// Set any value of the configuration, e.g. --set mapping.iterations_per_keyframe=20 (may be given again).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// The same file, named from the root.
fn absolute(path: &str) -> miette::Result<String> {
    Ok(std::path::absolute(path).into_diagnostic()?.to_string_lossy().into_owned())
}

/// See [`Budget`].
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BudgetName {
    /// Keep up with the recording's own pace: resolution and steps follow from what the adapter can do.
    Realtime,
    /// The defaults.
    Balanced,
    /// More steps and finer seeds.
    Quality,
}

impl From<BudgetName> for Budget {
    fn from(name: BudgetName) -> Self {
        match name {
            BudgetName::Realtime => Self::Realtime,
            BudgetName::Balanced => Self::Balanced,
            BudgetName::Quality => Self::Quality,
        }
    }
}

fn parse_bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| !c.is_ascii_digit());
    let unit: u64 = match text[digits.len()..].to_ascii_uppercase().as_str() {
        "" | "B" => 1,
        "K" | "KB" => 1 << 10,
        "M" | "MB" => 1 << 20,
        "G" | "GB" => 1 << 30,
        _ => return Err(format!("`{text}` is no amount of memory; write 500M or 2G")),
    };
    let bytes = digits.parse::<u64>().ok().and_then(|n| n.checked_mul(unit));
    bytes.ok_or_else(|| format!("`{text}` is no amount of memory; write 500M or 2G"))
}

/// Where a range without an end ends; TOML's numbers go no further.
const OPEN_END: usize = i64::MAX as usize;

fn parse_range(text: &str) -> Result<(usize, usize), String> {
    let wrong = || format!("`{text}` is no range; write A..B, like 0..200, with A below B");
    let (start, end) = text.split_once("..").ok_or_else(wrong)?;
    let number = |part: &str, default| if part.is_empty() { Ok(default) } else { part.parse().map_err(|_| wrong()) };
    let (start, end) = (number(start, 0)?, number(end, OPEN_END)?);
    if start < end { Ok((start, end)) } else { Err(wrong()) }
}

impl RunArgs {
    pub fn resolve(&self) -> miette::Result<Config> {
        let mut config = match &self.config {
            Some(path) => Config::read_with(path, self.known_poses).into_diagnostic()?,
            None if self.known_poses => Config::offline(),
            None => Config::default(),
        };
        if let Some(budget) = self.budget {
            config = Budget::from(budget).apply(&config).into_diagnostic()?;
        }
        if let Some(path) = &self.sequence {
            // Absolute, so that the written configuration finds it from anywhere.
            let path = std::path::absolute(path).into_diagnostic()?;
            config.sequence = Some(SequenceConfig { path, ..SequenceConfig::default() });
        }
        let sequence = config
            .sequence
            .as_mut()
            .ok_or_else(|| miette!("which recording? Give its folder or video: keysplat run <SEQUENCE> --out <DIR>"))?;
        sequence.layout = self.layout.or(sequence.layout);
        sequence.sensor = self.sensor.or(sequence.sensor);
        if let Some(camera) = &self.camera {
            sequence.camera = Some(if is_camera_file(camera) { absolute(camera)? } else { camera.clone() });
        }
        config.map_scale = self.map_scale.unwrap_or(config.map_scale);
        config.replay.every = self.every.unwrap_or(config.replay.every);
        config.replay.frames = self.frames.or(config.replay.frames);
        config.replay.paced |= self.paced;
        config.adapter = self.adapter.clone().or(config.adapter);
        config.checkpoint_every = self.checkpoint_every.or(config.checkpoint_every);
        config.mapping.limits.max_gaussians = self.max_gaussians.or(config.mapping.limits.max_gaussians);
        config.mapping.limits.max_gpu_bytes = self.max_gpu_memory.or(config.mapping.limits.max_gpu_bytes);
        config.with_settings(&self.set).into_diagnostic()
    }
}

pub fn run(args: RunArgs, verbosity: Verbosity) -> miette::Result<()> {
    let mut config = args.resolve()?;
    if args.budget == Some(BudgetName::Realtime) && args.map_scale.is_none() {
        let sequence = open(&mut config)?;
        let gpu = Gpu::open(config.adapter.as_deref()).into_diagnostic()?;
        config.map_scale = pipeline::realtime_scale(&gpu, &sequence, &config).into_diagnostic()?;
    }
    let stop = Arc::new(AtomicBool::new(false));
    progress::stop_on_ctrl_c(&stop)?;
    replay(config, args.out, None, stop, verbosity)
}

/// Opens the recording that a configuration names, with its selection of frames. A range that goes on beyond the recording then
/// ends with it.
pub fn open(config: &mut Config) -> miette::Result<Sequence> {
    let named = config.sequence.as_ref().ok_or_else(|| miette!("the configuration names no recording"))?;
    if named.path.is_file() {
        tracing::info!("decoding {} for the times of its frames", named.path.display());
    }
    let mut sequence = Sequence::open(&named.path, named.layout, named.camera.as_deref()).into_diagnostic()?;
    if let Some(kind) = named.sensor {
        sequence.restrict_to(kind).into_diagnostic()?;
    }
    let recorded = sequence.entries.len();
    let range = config.replay.frames.map(|(start, end)| start..end);
    sequence.select(range, config.replay.every).into_diagnostic()?;
    config.replay.frames = config.replay.frames.map(|(start, end)| (start, end.min(recorded)));
    pipeline::check_size(&sequence, config.map_scale).into_diagnostic()?;
    if config.replay.known_poses {
        pipeline::check_known_poses(&sequence).into_diagnostic()?;
    }
    Ok(sequence)
}

/// Replays, writes everything, measures, prints. What was made is written before an error is reported. Goes on from a checkpoint, if given.
pub fn replay(
    mut config: Config,
    out: PathBuf,
    from: Option<Checkpoint>,
    stop: Arc<AtomicBool>,
    verbosity: Verbosity,
) -> miette::Result<()> {
    let sequence = open(&mut config)?;
    let config = &config;
    if !config.replay.known_poses {
        pipeline::check_first_depth(&sequence).into_diagnostic()?;
    }
    let gpu = Gpu::open(config.adapter.as_deref()).into_diagnostic()?;
    let _lock = outputs::prepare_folder(&out).into_diagnostic()?;
    let checkpoints = checkpoints(from, (&sequence, config), &gpu, &out)?;
    tracing::info!(
        sequence = sequence.name,
        sensor = %sequence.sensor.kind(),
        frames = sequence.entries.len(),
        adapter = gpu.adapter.name,
        "replaying into {}",
        out.display()
    );
    let windows = Progress { stop, ..Progress::default() };
    let done = AtomicBool::new(false);
    let mut outcome = std::thread::scope(|scope| {
        let (windows, done) = (&windows, &done);
        let bar = progress::bar(verbosity, sequence.entries.len() as u64, "{wide_bar} {pos}/{len} frames  {msg}");
        scope.spawn(move || show(windows, &bar, done));
        let outcome = pipeline::run(&sequence, &gpu, config, windows, checkpoints);
        done.store(true, Ordering::Relaxed);
        outcome
    })
    .into_diagnostic()?;
    let error = outcome.error.take();
    if outcome.poses.is_empty() {
        return nothing_made(sequence.sensor, error, windows.stopped());
    }
    let finished = write_and_measure((&sequence, config), &gpu, &outcome, &out, verbosity);
    if error.is_none() && finished.is_ok() && !windows.stopped() {
        outputs::remove_checkpoint(&out).into_diagnostic()?;
    } else if config.checkpoint_every.is_some() {
        tracing::info!("keysplat resume {} goes on from the last checkpoint", out.display());
    }
    match (error, finished) {
        (None, finished) => finished,
        (Some(error), Ok(())) => Err(miette!("{error}\nThe run ended early; what there was until then is in {}", out.display())),
        (Some(error), Err(then)) => Err(miette!("{error}\nThe run ended early, and then: {then}")),
    }
}

/// Those of the run, if it keeps any.
fn checkpoints(
    from: Option<Checkpoint>,
    recording: (&Sequence, &Config),
    gpu: &Gpu,
    out: &Path,
) -> miette::Result<Option<Checkpoints>> {
    if let Some(checkpoint) = from {
        return Checkpoints::resume(checkpoint, recording, gpu).map(Some).into_diagnostic();
    }
    let begin = |_| Checkpoints::begin(&out.join(outputs::CHECKPOINT), recording, gpu);
    recording.1.checkpoint_every.map(begin).transpose().into_diagnostic()
}

fn write_and_measure(
    (sequence, config): (&Sequence, &Config),
    gpu: &Arc<Gpu>,
    outcome: &Outcome,
    out: &Path,
    verbosity: Verbosity,
) -> miette::Result<()> {
    let map = outputs::write_results(out, outcome, config).into_diagnostic()?;
    let bar = progress::bar(verbosity, outcome.poses.len() as u64, "{wide_bar} {pos}/{len} views compared");
    let measured = outputs::measure((sequence, config), gpu, &subject(outcome), out, &|done| bar.set_position(done as u64));
    bar.finish_and_clear();
    let measured = measured.into_diagnostic()?;
    let metrics = outputs::write_metrics((sequence, config), gpu, outcome, (measured, map), out).into_diagnostic()?;
    print_metrics(&metrics, verbosity)
}

/// Without a pose there is no trajectory, no map and no figure; what an earlier run left in the folder stays.
fn nothing_made(sensor: Sensor, error: Option<PipelineError>, stopped: bool) -> miette::Result<()> {
    match error {
        Some(error) => Err(miette!("{error}")),
        None if stopped => {
            tracing::warn!("stopped before a frame was tracked, so nothing was written");
            Ok(())
        }
        None if sensor == Sensor::Mono => Err(miette!(
            "not one frame could be tracked; the recording was replayed as mono, which needs texture and a camera that moves \
             sideways; if it has depth, check that its depth.txt, or its depth folder, is there"
        )),
        None => Err(miette!(
            "not one frame could be tracked; the images need texture, and depth between tracking.min_depth_metres and \
             tracking.max_depth_metres"
        )),
    }
}

fn subject(outcome: &Outcome) -> outputs::Subject<'_> {
    outputs::Subject {
        trajectory: &outcome.trajectory,
        poses: outcome.poses.iter().map(|(index, pose)| (*index, pose.world_from_camera)).collect(),
        keyframes: outcome.keyframe_trajectory(),
        keyframe_indices: outcome.keyframes.iter().map(|k| k.frame_index).collect(),
        cloud: &outcome.cloud,
        exposures: outcome.exposures(),
    }
}

/// Keeps the bar up to date until the run is done.
fn show(windows: &Progress, bar: &ProgressBar, done: &AtomicBool) {
    let started = Instant::now();
    let (mut keyframes, mut lost, mut mapped) = (0, "", String::new());
    while !done.load(Ordering::Relaxed) {
        if let Some(tracking) = windows.tracking.pop() {
            bar.set_position(tracking.frames_done as u64);
            keyframes = tracking.keyframes;
            lost = if tracking.lost { "  LOST" } else { "" };
        }
        if let Some(map) = windows.mapping.pop() {
            mapped = format!(", {} mapped, {} Gaussians, {:.1} dB", map.keyframes, map.cloud.len(), map.psnr_db);
        }
        let rate = bar.position() as f64 / started.elapsed().as_secs_f64().max(1e-3);
        bar.set_message(format!("{rate:.1}/s  {keyframes} keyframes{mapped}{lost}"));
        std::thread::sleep(Duration::from_millis(100));
    }
    bar.finish_and_clear();
}

#[cfg(test)]
mod tests {
    use super::{parse_bytes, parse_range};

    #[test]
    fn amounts_of_memory_have_units() {
        assert_eq!(parse_bytes("500M"), Ok(500 << 20));
        assert_eq!((parse_bytes("2g"), parse_bytes("4096")), (Ok(2 << 30), Ok(4096)));
        assert!(["", "M", "-1M", "5T", "99999999999999999999"].iter().all(|text| parse_bytes(text).is_err()));
    }

    #[test]
    fn ranges_may_be_open() {
        assert_eq!(parse_range("3..9"), Ok((3, 9)));
        assert_eq!(parse_range("..9"), Ok((0, 9)));
        assert_eq!(parse_range("3.."), Ok((3, super::OPEN_END)));
        assert!(["9..3", "3", "a..b", "3..3"].iter().all(|text| parse_range(text).is_err()));
    }
}
