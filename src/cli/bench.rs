//! `keysplat bench`

mod ablation;
mod host;
mod sweep;
pub(super) mod track;
mod walk;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use keysplat::calibration::{BenchScene, Rates, StepBench, StepReport, bench_step, measure_rates};
use keysplat::geometry::{Pinhole, Se3, Trajectory};
use keysplat::gpu::{AdapterSummary, Gpu, GpuError};
use keysplat::render::BlendForm;
use keysplat::run_folder::outputs;
use keysplat::sequence::{RectifiedImage, Rectifier};
use keysplat::splat::{GaussianCloud, ShDegree, ViewCamera};
use keysplat::{Config, Recording};
use miette::{IntoDiagnostic, miette};
use serde::Serialize;

use super::Verbosity;

#[derive(Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// One training step, on made-up scenes or on the map of a run, stage by stage, beside what the adapter could do at its best.
    Step(StepArgs),
    /// CPU time of the mapping thread for a keyframe by part, and what passes between it and the adapter.
    Host(host::HostArgs),
    /// Mappers with different settings on the same keyframes of a recording: time, Gaussians, held-out quality.
    Ablation(Box<ablation::AblationArgs>),
    /// Whole runs over sequences, numbers of steps and seeds: what time buys, as table and curves.
    Sweep(sweep::SweepArgs),
    /// The tracker on many replays of recordings: start frames, directions, missing frames; distributions of its errors.
    Track(track::TrackArgs),
    /// The tracker on simulated walks of any length: time a frame, memory, loops, errors.
    Walk(walk::WalkArgs),
    /// Changes between two sweeps.
    Compare(sweep::CompareArgs),
}

#[derive(Args)]
struct StepArgs {
    /// Folder of a run whose map is seen from its middle keyframe, instead of made-up scenes.
    #[arg(long, conflicts_with_all = ["size", "sh"])]
    run: Option<PathBuf>,
    /// Numbers of Gaussians; of a run's map, that many spread evenly over it.
    #[arg(long, value_delimiter = ',', default_values_t = [10_000usize, 110_000, 500_000])]
    gaussians: Vec<usize>,
    /// Image sizes.
    #[arg(long, value_delimiter = ',', value_parser = parse_size, default_value = "320x240,640x480,1200x680")]
    size: Vec<(u32, u32)>,
    /// Degrees of the spherical harmonics.
    #[arg(long, value_delimiter = ',', default_values_t = [0u8, 1, 3])]
    sh: Vec<u8>,
    /// Form of the blending passes: the adapter's own by default.
    #[arg(long, value_enum)]
    form: Option<Form>,
    /// Timed steps per scene.
    #[arg(long, default_value_t = 12)]
    steps: usize,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
    /// Write the JSON to a file as well.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

/// See [`BlendForm`].
#[derive(Clone, Copy, ValueEnum)]
enum Form {
    Wide,
    Narrow,
}

impl From<Form> for BlendForm {
    fn from(form: Form) -> Self {
        match form {
            Form::Wide => Self::Wide,
            Form::Narrow => Self::Narrow,
        }
    }
}

pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let wrong = || format!("`{text}` is no size; write WIDTHxHEIGHT, like 640x480");
    let (width, height) = text.split_once('x').ok_or_else(wrong)?;
    let number = |part: &str| part.parse().ok().filter(|n| (16..=4096).contains(n)).ok_or_else(wrong);
    Ok((number(width)?, number(height)?))
}

#[derive(Serialize)]
struct Report {
    adapter: AdapterSummary,
    cpu: Option<String>,
    version: &'static str,
    rates: Rates,
    /// Of a run's map.
    view: Option<ViewReport>,
    steps: Vec<StepReport>,
    /// Scenes that the adapter cannot hold.
    too_large: Vec<StepBench>,
}

/// A view in numbers that others can use.
#[derive(Serialize)]
struct ViewReport {
    fx: f64,
    fy: f64,
    /// Pixel centres are integers.
    cx: f64,
    cy: f64,
    width: u32,
    height: u32,
    /// Rows of the 4×4 matrix.
    camera_from_world: [[f64; 4]; 4],
}

impl From<&ViewCamera> for ViewReport {
    fn from(camera: &ViewCamera) -> Self {
        let Pinhole { fx, fy, cx, cy, width, height } = camera.pinhole;
        let matrix = camera.camera_from_world.to_homogeneous();
        let camera_from_world = std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]));
        Self { fx, fy, cx, cy, width, height, camera_from_world }
    }
}

pub fn bench(args: &BenchArgs, verbosity: Verbosity) -> miette::Result<()> {
    match &args.what {
        What::Step(args) => step(args),
        What::Host(args) => host::host(args),
        What::Ablation(args) => ablation::ablation(args),
        What::Sweep(args) => sweep::sweep(args, verbosity),
        What::Track(args) => track::track(args, verbosity),
        What::Walk(args) => walk::walk(args, verbosity),
        What::Compare(args) => sweep::compare(args),
    }
}

/// A report without steps.
fn empty_report(gpu: &Gpu, rates: Rates) -> Report {
    Report {
        adapter: gpu.adapter.clone(),
        cpu: keysplat::evaluation::machine::cpu_name(),
        version: env!("CARGO_PKG_VERSION"),
        rates,
        view: None,
        steps: Vec::new(),
        too_large: Vec::new(),
    }
}

fn step(args: &StepArgs) -> miette::Result<()> {
    let gpu = Gpu::open_profiled(args.adapter.as_deref()).into_diagnostic()?;
    let rates = measure_rates(&gpu).into_diagnostic()?;
    let form = args.form.map_or(BlendForm::of(&gpu), BlendForm::from);
    let steps = args.steps;
    let config = |gaussians, width, height, sh_degree| StepBench { gaussians, width, height, sh_degree, form, steps };
    let mut report = empty_report(&gpu, rates);
    if !args.json {
        println!("{} [{}, {}]", gpu.adapter.name, gpu.adapter.kind, gpu.adapter.driver);
        println!("copy {:.1} GB/s   multiply-add {:.1} GFLOP/s", rates.bytes_per_s * 1e-9, rates.flops_per_s * 1e-9);
    }
    let mut measure = |scene: Result<BenchScene, GpuError>, bench: StepBench| {
        // A scene that the adapter cannot hold is noted, and the others are measured.
        match scene.and_then(|scene| bench_step(&gpu, scene, &bench, &rates)) {
            Ok(measured) => {
                if !args.json {
                    print(&measured);
                }
                report.steps.push(measured);
            }
            Err(refused @ GpuError::TooLarge { .. }) => {
                tracing::warn!(?bench, "not measured: {refused}");
                report.too_large.push(bench);
            }
            Err(error) => return Err(error).into_diagnostic(),
        }
        Ok::<_, miette::Report>(())
    };
    let recorded = args.run.as_deref().map(RecordedView::open).transpose()?;
    let view = recorded.as_ref().map(|recorded| ViewReport::from(&recorded.camera()));
    for &gaussians in &args.gaussians {
        if let Some(view) = &recorded {
            let cloud = view.cloud.thinned(gaussians);
            let Pinhole { width, height, .. } = view.image.pinhole;
            let depth = view.image.depth.as_ref().map(|depth| depth.metres.as_slice());
            let scene = BenchScene::of_map(&gpu, &cloud, view.camera(), &view.image.color, depth);
            let sh_degree = cloud.sh_degree;
            measure(scene, config(cloud.len(), width, height, sh_degree))?;
            continue;
        }
        for &(width, height) in &args.size {
            for &degree in &args.sh {
                let sh_degree = ShDegree::new(degree).ok_or_else(|| miette!("--sh takes degrees 0 to 3, not {degree}"))?;
                let scene = BenchScene::new(&gpu, gaussians, (width, height), sh_degree);
                measure(scene, config(gaussians, width, height, sh_degree))?;
            }
        }
    }
    report.view = view;
    write(&report, args)
}

fn write(report: &Report, args: &StepArgs) -> miette::Result<()> {
    let text = serde_json::to_string_pretty(report).into_diagnostic()?;
    if let Some(path) = &args.out {
        keysplat::files::write_atomically(path, text.as_bytes()).into_diagnostic()?;
    }
    if args.json {
        println!("{text}");
    }
    Ok(())
}

/// A run's map, and its middle keyframe as it was recorded.
struct RecordedView {
    cloud: GaussianCloud,
    world_from_camera: Se3,
    image: RectifiedImage,
}

impl RecordedView {
    fn camera(&self) -> ViewCamera {
        ViewCamera { pinhole: self.image.pinhole, camera_from_world: self.world_from_camera.inverse() }
    }

    fn open(dir: &Path) -> miette::Result<Self> {
        let recording = Recording::open(Config::read(&dir.join(outputs::CONFIG)).into_diagnostic()?).into_diagnostic()?;
        let (sequence, config) = (recording.sequence(), recording.config());
        let keyframes = Trajectory::read_tum(&dir.join(outputs::KEYFRAMES)).into_diagnostic()?;
        let middle =
            keyframes.poses.get(keyframes.poses.len() / 2).ok_or_else(|| miette!("{} has no keyframes", dir.display()))?;
        let frame = sequence.entries.partition_point(|e| e.timestamp_s < middle.timestamp_s - 1e-4);
        let frame = frame.min(sequence.entries.len() - 1);
        let rectifier = Rectifier::new(sequence.camera_of(frame), config.map_scale);
        let image = rectifier.rectify(&sequence.load(frame).into_diagnostic()?);
        let (map, format) = outputs::find_map(dir).ok_or_else(|| miette!("{} has no map", dir.display()))?;
        let cloud = format.read(&map).into_diagnostic()?;
        Ok(Self { cloud, world_from_camera: middle.world_from_camera, image })
    }
}

fn print(r: &StepReport) {
    let b = &r.bench;
    println!("\n{} Gaussians, {}x{}, SH {}", b.gaussians, b.width, b.height, b.sh_degree.get());
    let w = &r.work;
    println!(
        "  visible {}   intersections {}   evaluations {}   blended {}",
        w.visible, w.intersections, w.evaluations, w.blended
    );
    for (stage, lanes) in [("lists", w.lanes.lists), ("slot sums", w.lanes.slot_sums)] {
        println!("  {stage}: lane efficiency {:.2}, longest lane {}", lanes.efficiency(), lanes.longest);
    }
    for stage in &r.stages {
        println!("  {:<24}{:>9.3} ms   floor {:>8.3} ms", stage.stage, stage.ms, stage.floor_ms);
    }
    let rate = r.evaluations_per_s.map_or_else(String::new, |e| format!("   {:.0} M forward evaluations/s", e * 1e-6));
    println!("  {:<24}{:>9.3} ms   floor {:>8.3} ms{rate}", "whole step (wall)", r.step_ms, r.floor_ms);
    println!("  {:<24}{:>9.3} ms", "encoding (host)", r.encode_ms);
}
