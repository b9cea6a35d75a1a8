//! `keysplat eval`: measures a folder with `trajectory.txt` and `map.ply`, whoever made them.

use std::collections::BTreeSet;
use std::path::PathBuf;

use clap::Args;
use keysplat::config::Config;
use keysplat::evaluation::trajectory::MAX_TIME_DIFFERENCE_S;
use keysplat::evaluation::{Exposures, Metrics, sha256_hex, write_json};
use keysplat::export::MapFormat;
use keysplat::geometry::{Se3, Trajectory};
use keysplat::gpu::Gpu;
use keysplat::pipeline::outputs::{self, Measured, Subject};
use keysplat::sequence::Sequence;
use keysplat::splat::GaussianCloud;
use miette::IntoDiagnostic;

use super::{Verbosity, print_metrics, progress, run};

#[derive(Args)]
pub struct EvalArgs {
    /// Folder of the run: `trajectory.txt` and `map.ply`, and, from keysplat, `keyframes.txt`, `config.toml` and `metrics.json`.
    dir: PathBuf,
    /// The recording, where the folder has no `config.toml` that names it, or it has moved.
    #[arg(long)]
    sequence: Option<PathBuf>,
    /// Resolution to compare at, as a share of the recorded one; the run's own where it is known.
    #[arg(long)]
    map_scale: Option<f64>,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

pub fn eval(args: &EvalArgs, verbosity: Verbosity) -> miette::Result<()> {
    for name in [outputs::TRAJECTORY, outputs::MAP] {
        if !args.dir.join(name).is_file() {
            miette::bail!(
                "there is no file {}; give a run's folder, with trajectory.txt and map.ply",
                args.dir.join(name).display()
            );
        }
    }
    let mut config = resolve(args)?;
    let sequence = run::open(&mut config)?;
    let earlier = earlier_metrics(args)?;
    let trajectory = Trajectory::read_tum(&args.dir.join(outputs::TRAJECTORY)).into_diagnostic()?;
    let keyframes_file = args.dir.join(outputs::KEYFRAMES);
    let keyframes =
        if keyframes_file.is_file() { Trajectory::read_tum(&keyframes_file).into_diagnostic()? } else { Trajectory::default() };
    let map_file = args.dir.join(outputs::MAP);
    let cloud = MapFormat::Ply.read(&map_file).into_diagnostic()?;
    let map_bytes = std::fs::read(&map_file).into_diagnostic()?;
    let poses = frames_of(&sequence, &trajectory);
    if poses.is_empty() {
        miette::bail!(
            "no pose of {} is within {MAX_TIME_DIFFERENCE_S} s of a frame of {}; name the right recording with --sequence",
            args.dir.join(outputs::TRAJECTORY).display(),
            sequence.name
        );
    }
    let gpu = Gpu::open(config.adapter.as_deref()).into_diagnostic()?;
    let _lock = outputs::prepare_folder(&args.dir).into_diagnostic()?;
    let subject = Subject {
        trajectory: &trajectory,
        keyframe_indices: frames_of(&sequence, &keyframes).into_iter().map(|(index, _)| index).collect::<BTreeSet<usize>>(),
        keyframes,
        cloud: &cloud,
        exposures: exposures(args)?,
        poses,
    };
    let bar = progress::bar(verbosity, subject.poses.len() as u64, "{wide_bar} {pos}/{len} views compared");
    let measured = outputs::measure((&sequence, &config), &gpu, &subject, &args.dir, &|done| bar.set_position(done as u64));
    bar.finish_and_clear();
    let mut metrics = earlier.unwrap_or_else(|| foreign_metrics(&sequence, &config));
    fill(&mut metrics, measured.into_diagnostic()?, &cloud, &map_bytes);
    metrics.frames_tracked = subject.poses.len() as u64;
    metrics.keyframes = (!subject.keyframes.poses.is_empty()).then_some(subject.keyframes.poses.len() as u64);
    metrics.adapter = Some(outputs::adapter(&gpu));
    write_json(&metrics, &args.dir.join(outputs::METRICS)).into_diagnostic()?;
    print_metrics(&metrics, verbosity)
}

fn resolve(args: &EvalArgs) -> miette::Result<Config> {
    let own = args.dir.join(outputs::CONFIG);
    let mut config = if own.is_file() { Config::read(&own).into_diagnostic()? } else { Config::default() };
    if let Some(path) = &args.sequence {
        config.sequence.get_or_insert_default().path.clone_from(path);
    }
    config.map_scale = args.map_scale.unwrap_or(config.map_scale);
    config.adapter = args.adapter.clone().or(config.adapter);
    config.validate().into_diagnostic()?;
    if config.sequence.is_none() {
        miette::bail!("{} has no config.toml that names its recording; name it with --sequence", args.dir.display());
    }
    Ok(config)
}

/// The frame that each pose belongs to, by the nearest timestamp.
fn frames_of(sequence: &Sequence, trajectory: &Trajectory) -> Vec<(usize, Se3)> {
    let entries = &sequence.entries;
    let nearest = |t: f64| {
        let after = entries.partition_point(|e| e.timestamp_s < t);
        let candidates = after.saturating_sub(1)..(after + 1).min(entries.len());
        candidates
            .map(|i| (i, (entries[i].timestamp_s - t).abs()))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .filter(|(_, difference)| *difference <= MAX_TIME_DIFFERENCE_S)
    };
    trajectory.poses.iter().filter_map(|pose| Some((nearest(pose.timestamp_s)?.0, pose.world_from_camera))).collect()
}

/// Those of the run, if it has any.
fn exposures(args: &EvalArgs) -> miette::Result<Exposures> {
    let path = args.dir.join(outputs::EXPOSURES);
    if !path.is_file() {
        return Ok(Exposures::default());
    }
    let text = std::fs::read_to_string(&path).into_diagnostic()?;
    Exposures::parse(&text).ok_or_else(|| {
        miette::miette!("{} does not hold exposures; move it away to compare with the map's own colours", path.display())
    })
}

fn earlier_metrics(args: &EvalArgs) -> miette::Result<Option<Metrics>> {
    let path = args.dir.join(outputs::METRICS);
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).into_diagnostic()?;
    serde_json::from_str(&text).map(Some).map_err(|error| {
        miette::miette!("{} is not this version's ({error}); move it away to have it written anew", path.display())
    })
}

/// Figures of a run that somebody else made: what the folder cannot tell stays empty.
fn foreign_metrics(sequence: &Sequence, config: &Config) -> Metrics {
    Metrics {
        sequence: sequence.name.clone(),
        sensor: sequence.sensor.kind(),
        paced: config.replay.paced,
        frames: sequence.entries.len() as u64,
        frames_read_failed: 0,
        frames_tracked: 0,
        frames_late: 0,
        keyframes_deferred: 0,
        keyframes: None,
        ate_rmse_m: Default::default(),
        rpe: Default::default(),
        images: Default::default(),
        gaussians: None,
        map_bytes: None,
        map_hash: None,
        wall_s: None,
        resumed: 0,
        tracking_ms: None,
        mapping: None,
        peak_host_bytes: None,
        peak_gpu_bytes: None,
        adapter: None,
        cpu: keysplat::evaluation::machine::cpu_name(),
        threads: std::thread::available_parallelism().map_or(1, |n| n.get() as u64),
        version: env!("CARGO_PKG_VERSION").into(),
        config_hash: None,
    }
}

fn fill(metrics: &mut Metrics, measured: Measured, cloud: &GaussianCloud, map_bytes: &[u8]) {
    metrics.ate_rmse_m = measured.ate_rmse_m;
    metrics.rpe = measured.rpe;
    metrics.images = measured.images;
    metrics.gaussians = Some(cloud.len() as u64);
    metrics.map_bytes = Some(map_bytes.len() as u64);
    metrics.map_hash = Some(sha256_hex(map_bytes));
}
