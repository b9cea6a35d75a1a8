//! `keysplat bench`

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use keysplat::bench::{Rates, StepBench, StepReport, bench_step, measure_rates};
use keysplat::gpu::{AdapterSummary, Gpu};
use keysplat::render::BlendForm;
use keysplat::splat::ShDegree;
use miette::{IntoDiagnostic, miette};
use serde::Serialize;

#[derive(Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// One training step on made-up scenes, stage by stage, beside what the adapter could do at its best.
    Step(StepArgs),
}

#[derive(Args)]
struct StepArgs {
    /// Numbers of Gaussians.
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

fn parse_size(text: &str) -> Result<(u32, u32), String> {
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
    steps: Vec<StepReport>,
}

pub fn bench(args: &BenchArgs) -> miette::Result<()> {
    match &args.what {
        What::Step(args) => step(args),
    }
}

fn step(args: &StepArgs) -> miette::Result<()> {
    let gpu = Gpu::open_profiled(args.adapter.as_deref()).into_diagnostic()?;
    let rates = measure_rates(&gpu).into_diagnostic()?;
    let form = match args.form {
        None => BlendForm::of(&gpu),
        Some(Form::Wide) => BlendForm::Wide,
        Some(Form::Narrow) => BlendForm::Narrow,
    };
    let mut report = Report {
        adapter: gpu.adapter.clone(),
        cpu: keysplat::evaluation::machine::cpu_name(),
        version: env!("CARGO_PKG_VERSION"),
        rates,
        steps: Vec::new(),
    };
    if !args.json {
        println!("{} [{}, {}]", gpu.adapter.name, gpu.adapter.kind, gpu.adapter.driver);
        println!("copy {:.1} GB/s   multiply-add {:.1} GFLOP/s", rates.bytes_per_s * 1e-9, rates.flops_per_s * 1e-9);
    }
    for &gaussians in &args.gaussians {
        for &(width, height) in &args.size {
            for &degree in &args.sh {
                let sh_degree = ShDegree::new(degree).ok_or_else(|| miette!("--sh takes degrees 0 to 3, not {degree}"))?;
                let bench = StepBench { gaussians, width, height, sh_degree, form, steps: args.steps };
                let measured = bench_step(&gpu, &bench, &rates).into_diagnostic()?;
                if !args.json {
                    print(&measured);
                }
                report.steps.push(measured);
            }
        }
    }
    let text = serde_json::to_string_pretty(&report).into_diagnostic()?;
    if let Some(path) = &args.out {
        keysplat::export::write_atomically(path, text.as_bytes()).into_diagnostic()?;
    }
    if args.json {
        println!("{text}");
    }
    Ok(())
}

fn print(r: &StepReport) {
    let b = &r.bench;
    println!("\n{} Gaussians, {}x{}, SH {}", b.gaussians, b.width, b.height, b.sh_degree.get());
    let w = &r.work;
    println!("  visible {}   pairs {}   evaluations {}   blended {}", w.visible, w.pairs, w.evaluations, w.blended);
    for stage in &r.stages {
        println!("  {:<24}{:>9.3} ms   floor {:>8.3} ms", stage.stage, stage.ms, stage.floor_ms);
    }
    let rate = r.evaluations_per_s.map_or_else(String::new, |e| format!("   {:.0} M forward evaluations/s", e * 1e-6));
    println!("  {:<24}{:>9.3} ms   floor {:>8.3} ms{rate}", "whole step (wall)", r.step_ms, r.floor_ms);
    println!("  {:<24}{:>9.3} ms", "encoding (host)", r.encode_ms);
}
