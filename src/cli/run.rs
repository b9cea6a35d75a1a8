//! `keysplat run`

use std::path::PathBuf;
use std::sync::{Arc, Weak};
use std::time::Duration;

use clap::Args;
use indicatif::ProgressBar;
use keysplat::config::SequenceConfig;
use keysplat::export::MapFormat;
use keysplat::mapping::RefineConfig;
use keysplat::pipeline::{Outlook, Replay};
use keysplat::presets::{self, Preset};
use keysplat::sequence::{ASSUMED_CAMERA, is_camera_file};
use keysplat::{Config, Gpu, Metrics, Progress, Recording, Session, SessionError};
use miette::{IntoDiagnostic, miette};

use super::calibrate::{self, find_camera};
use super::keys::{Keys, steer};
use super::source::SourceArgs;
use super::view::{ViewOptions, Viewed};
use super::{Verbosity, print_metrics, progress};

#[derive(Args, Clone)]
pub struct RunArgs {
    /// Folder of the recording, or a video; may also stand in the configuration.
    sequence: Option<PathBuf>,
    /// Folder for the results.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Configuration (TOML); options on the command line go before it.
    #[arg(short, long)]
    config: Option<PathBuf>,
    #[command(flatten)]
    source: SourceArgs,
    /// Mapping resolution as a share of the recorded one, e.g. 0.5. Without it and without --config it follows from the kind of adapter.
    #[arg(long)]
    map_scale: Option<f64>,
    /// File format of the map, `map.<extension>` in the folder of the results.
    #[arg(long, value_enum)]
    format: Option<MapFormat>,
    /// Replay every n-th frame.
    #[arg(long)]
    every: Option<usize>,
    /// Replay frames A..B only (B excluded; either may be left out).
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    frames: Option<(usize, usize)>,
    /// Let frames arrive by their timestamps and drop what comes too late.
    #[arg(long, alias = "paced")]
    real_time: bool,
    /// Track nothing: take the poses that the recording knows (COLMAP, transforms.json, ground truth), and refine the map over all
    /// keyframes after the last one.
    #[arg(long)]
    known_poses: bool,
    /// Begin with this map (.ply, .spz, .sog, .glb, .splat, or the folder of a run) instead of points. It lies in the world of the known
    /// poses.
    #[arg(long, value_name = "MAP")]
    initial_map: Option<PathBuf>,
    /// Refine a finished run further, with its poses, exposures, map and settings. Its recording is that of the run unless it is named.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["config", "known_poses", "initial_map", "preset", "real_time"])]
    refine: Option<PathBuf>,
    /// Part of the name of the adapter to use (see `keysplat adapters`).
    #[arg(long)]
    adapter: Option<String>,
    /// Named settings; override the configuration file, and the other options override them. Without it and without --config it follows from
    /// the kind of adapter.
    #[arg(long, alias = "budget", value_enum)]
    preset: Option<Preset>,
    /// Consolidate the map for so many seconds after the last keyframe, whatever the preset's number of epochs. Such a run does not repeat.
    #[arg(long, value_name = "SECONDS")]
    time: Option<f64>,
    /// Most Gaussians that the map may have at any time; the least useful go first.
    #[arg(long)]
    max_gaussians: Option<usize>,
    /// Most GPU memory that the mapper may use, e.g. 500M or 2G.
    #[arg(long, value_parser = parse_bytes)]
    max_gpu_memory: Option<u64>,
    /// Most host memory, e.g. 500M or 2G: three quarters for images of keyframes that left the GPU, of which a temporary file holds the rest, and a
    /// quarter for the tracker's map.
    #[arg(long, value_parser = parse_bytes)]
    max_host_memory: Option<u64>,
    /// Keep a checkpoint after every so many keyframes (and rounds of a refinement), for `keysplat resume`.
    #[arg(long, value_name = "N")]
    checkpoint_every: Option<usize>,
    /// Set any value of the configuration, e.g. --set mapping.refine.final_epochs=40 (may be given again).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    view: ViewOptions,
}

/// The file's absolute path.
fn absolute(path: &str) -> miette::Result<String> {
    Ok(std::path::absolute(path).into_diagnostic()?.to_string_lossy().into_owned())
}

pub fn parse_bytes(text: &str) -> Result<u64, String> {
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

/// Host memory that the tracker has at least.
const LEAST_TRACKING_BYTES: u64 = 64 << 20;
/// How often the bar is brought up to date.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Where a range without an end ends; TOML's numbers go no further.
const OPEN_END: usize = i64::MAX as usize;

pub fn parse_range(text: &str) -> Result<(usize, usize), String> {
    let wrong = || format!("`{text}` is no range; write A..B, like 0..200, with A below B");
    let (start, end) = text.split_once("..").ok_or_else(wrong)?;
    let number = |part: &str, default| if part.is_empty() { Ok(default) } else { part.parse().map_err(|_| wrong()) };
    let (start, end) = (number(start, 0)?, number(end, OPEN_END)?);
    if start < end { Ok((start, end)) } else { Err(wrong()) }
}

impl RunArgs {
    /// The same with the camera found, where it is to be found from the frames.
    pub fn calibrated(&self, verbosity: Verbosity) -> miette::Result<Self> {
        let mut args = self.clone();
        if args.source.camera.as_deref() == Some(ASSUMED_CAMERA) {
            let path = args.sequence.as_deref().ok_or_else(|| miette!("--camera auto needs the recording's folder or video"))?;
            std::fs::create_dir_all(&args.out).into_diagnostic()?;
            let file = args.out.join("camera.toml");
            let range = args.frames.map(|(start, end)| (start, end.min(start.saturating_add(calibrate::FRAMES))));
            find_camera(path, args.source.layout, range, &file, verbosity)?;
            args.source.camera = Some(file.to_string_lossy().into_owned());
        }
        Ok(args)
    }

    /// Files that a run reads: its recording, and those that options or the configuration name.
    pub fn inputs(&self) -> miette::Result<Vec<PathBuf>> {
        let config = self.resolve(self.preset, None)?;
        let sequence = config.sequence.unwrap_or_default();
        let camera = sequence.camera.filter(|camera| is_camera_file(camera)).map(PathBuf::from);
        let run = config.refined.map(|refined| refined.run);
        let all = [Some(sequence.path), self.config.clone(), camera, config.initial_map, run];
        Ok(all.into_iter().flatten().collect())
    }

    /// Keeps a checkpoint after every so many keyframes, unless it is kept already or the run does not repeat.
    ///
    /// # Errors
    /// If the recording or the configuration cannot be used.
    pub fn keep_checkpoints(&mut self, every: usize) -> miette::Result<()> {
        let config = self.resolve(self.preset, None)?;
        let repeats = !config.replay.real_time && !config.mapping.depends_on_time();
        if repeats && config.checkpoint_every.is_none() {
            self.checkpoint_every = Some(every);
        }
        Recording::open(self.resolve(self.preset, None)?).into_diagnostic()?;
        Ok(())
    }

    /// Opens the recording and the adapter. Without a file, a preset and a mapping resolution that are not given follow from the adapter.
    pub fn open(&self) -> miette::Result<(Recording, Arc<Gpu>)> {
        let recording = Recording::open(self.resolve(self.preset, None)?).into_diagnostic()?;
        let gpu = Gpu::open(recording.config().adapter.as_deref()).into_diagnostic()?;
        let free = self.config.is_none() && self.refine.is_none();
        let preset = self.preset.or_else(|| free.then(|| Preset::for_adapter(&gpu.adapter)));
        let scale = match self.preset {
            _ if self.map_scale.is_some() => None,
            Some(Preset::Realtime) => Some(presets::realtime_scale(&gpu, &recording).into_diagnostic()?),
            _ => free.then(|| presets::default_scale(&gpu.adapter, &recording)),
        };
        Ok((recording.with_config(self.resolve(preset, scale)?).into_diagnostic()?, gpu))
    }

    /// The configuration, with `scale` where no option gives the mapping resolution.
    fn resolve(&self, preset: Option<Preset>, scale: Option<f64>) -> miette::Result<Config> {
        let mut config = match (&self.config, &self.refine) {
            (Some(path), _) => Config::read_with(path, self.known_poses).into_diagnostic()?,
            (None, Some(run)) => Config::refining(run).into_diagnostic()?,
            (None, None) if self.known_poses => Config::offline(),
            (None, None) => Config::default(),
        };
        if let Some(preset) = preset {
            preset.apply(&mut config);
        }
        if let Some(path) = &self.sequence {
            // Absolute, so that the written configuration finds it from anywhere.
            let path = std::path::absolute(path).into_diagnostic()?;
            let of_run = config.sequence.filter(|_| self.refine.is_some()).unwrap_or_default();
            config.sequence = Some(SequenceConfig { path, ..of_run });
        }
        let sequence = config
            .sequence
            .as_mut()
            .ok_or_else(|| miette!("which recording? Give its folder or video: keysplat run <SEQUENCE> --out <DIR>"))?;
        sequence.layout = self.source.layout.or(sequence.layout);
        sequence.sensor = self.source.sensor.or(sequence.sensor);
        if let Some(camera) = &self.source.camera {
            sequence.camera = Some(if is_camera_file(camera) { absolute(camera)? } else { camera.clone() });
        }
        config.map_scale = self.map_scale.or(scale).unwrap_or(config.map_scale);
        config.map_format = self.format.unwrap_or(config.map_format);
        if let Some(path) = self.initial_map.as_ref().or(config.initial_map.as_ref()) {
            config.initial_map = Some(std::path::absolute(path).into_diagnostic()?);
        }
        config.replay.every = self.every.unwrap_or(config.replay.every);
        config.replay.frames = self.frames.or(config.replay.frames);
        config.replay.real_time |= self.real_time;
        config.adapter = self.adapter.clone().or(config.adapter);
        config.checkpoint_every = self.checkpoint_every.or(config.checkpoint_every);
        config.mapping.refine.seconds = self.time.or(config.mapping.refine.seconds);
        config.mapping.limits.max_gaussians = self.max_gaussians.or(config.mapping.limits.max_gaussians);
        config.mapping.limits.max_gpu_bytes = self.max_gpu_memory.or(config.mapping.limits.max_gpu_bytes);
        if let Some(bytes) = self.max_host_memory {
            config.tracking.max_host_bytes = (bytes / 4).max(LEAST_TRACKING_BYTES);
            config.mapping.limits.max_host_bytes = bytes - bytes / 4;
        }
        config.with_settings(&self.set).into_diagnostic()
    }
}

pub fn run(args: &RunArgs, verbosity: Verbosity) -> miette::Result<()> {
    let args = args.calibrated(verbosity)?;
    let (recording, gpu) = args.open()?;
    replay(Session::with_device(recording, gpu, &args.out).into_diagnostic()?, &args.view, verbosity)
}

/// Runs a session to its metrics, with progress bars, and prints them.
pub fn replay(mut session: Session, view: &ViewOptions, verbosity: Verbosity) -> miette::Result<()> {
    let progress = Progress::default();
    let viewed = view.start(&session, &progress, verbosity)?;
    progress::stop_on_signals(&progress)?;
    let frames = session.recording().sequence().entries.len() as u64;
    let refine = session.recording().config().mapping.refine.clone();
    let shown = |work: &mut dyn FnMut() -> Result<Replay, SessionError>| {
        std::thread::scope(|scope| {
            // Dropped by a panic as well, so that the bar's thread always ends.
            let running = Arc::new(());
            let watched = Arc::downgrade(&running);
            let bar = progress::bar(verbosity, frames, "{wide_bar} {pos}/{len} frames  {msg}");
            let (progress, refine) = (&progress, &refine);
            scope.spawn(move || show(progress, refine, &bar, &watched));
            let replayed = work();
            drop(running);
            replayed
        })
    };
    let mut replayed = shown(&mut || session.run(&progress)).into_diagnostic()?;
    // A longer refinement does not make an unfinished run a finished one.
    let stopped = replayed.stopped;
    loop {
        viewed.iter().for_each(Viewed::measuring);
        let mut kept = replayed.kept.take().map(|kept| (kept, replayed.result.clone()));
        let bar = progress::bar(verbosity, replayed.result.poses.len() as u64, "{wide_bar} {pos}/{len} views compared");
        let finished = session.finish(replayed, &|views| bar.set_position(views as u64));
        bar.finish_and_clear();
        print_end(finished, verbosity)?;
        let mapper = kept.as_mut().map(|(mapper, _)| mapper);
        let Some(viewed) = viewed.as_ref().filter(|viewed| viewed.wants_more(&progress, mapper)) else { return Ok(()) };
        let Some((mut kept, mut result)) = kept else { return Ok(()) };
        viewed.refining();
        let mut refine = || {
            let error = kept.refine_on(&mut result, &progress).err();
            Ok(Replay { result: result.clone(), error, kept: None, stopped })
        };
        replayed = shown(&mut refine).into_diagnostic()?;
        replayed.kept = Some(kept);
    }
}

/// Prints the figures of a run, and its error if it ended in one.
fn print_end(finished: Result<Metrics, SessionError>, verbosity: Verbosity) -> miette::Result<()> {
    match finished {
        Ok(metrics) => print_metrics(&metrics, verbosity),
        Err(SessionError::Stopped) => {
            tracing::warn!("{}", SessionError::Stopped);
            Ok(())
        }
        Err(error) => {
            if let SessionError::EndedEarly { metrics, .. } = &error {
                print_metrics(metrics, verbosity)?;
            }
            Err(error).into_diagnostic()
        }
    }
}

/// Keeps the bar up to date, and heeds keys, while what is watched exists.
fn show(progress: &Progress, refine: &RefineConfig, bar: &ProgressBar, watched: &Weak<()>) {
    let keys = if bar.is_hidden() { None } else { Keys::listen() };
    let mut outlook = Outlook::new(bar.length().unwrap_or(0) as usize, refine);
    while watched.strong_count() > 0 {
        let state = outlook.look(progress);
        bar.set_position(state.frames as u64);
        bar.set_message(state.line());
        match &keys {
            Some(keys) => keys.wait(LOOK_EVERY).into_iter().for_each(|key| steer(key, progress)),
            None => std::thread::sleep(LOOK_EVERY),
        }
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
