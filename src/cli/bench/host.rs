//! `keysplat bench host`

use std::path::PathBuf;

use clap::Args;
use keysplat::calibration::{HostBench, HostReport, bench_host};
use keysplat::gpu::{AdapterSummary, Gpu};
use miette::IntoDiagnostic;
use serde::Serialize;

#[derive(Args)]
pub struct HostArgs {
    /// Numbers of Gaussians.
    #[arg(long, value_delimiter = ',', default_values_t = [50_000usize, 500_000])]
    gaussians: Vec<usize>,
    /// Image sizes.
    #[arg(long, value_delimiter = ',', value_parser = super::parse_size, default_value = "640x480,1200x680")]
    size: Vec<(u32, u32)>,
    /// Measured keyframes.
    #[arg(long, default_value_t = 4)]
    keyframes: usize,
    /// Write the figures as JSON to a file as well.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

#[derive(Serialize)]
struct Report {
    adapter: AdapterSummary,
    cpu: Option<String>,
    version: &'static str,
    keyframes: Vec<HostReport>,
}

pub fn host(args: &HostArgs) -> miette::Result<()> {
    let gpu = Gpu::open(args.adapter.as_deref()).into_diagnostic()?;
    let cpu = keysplat::evaluation::machine::cpu_name();
    let mut report = Report { adapter: gpu.adapter.clone(), cpu, version: env!("CARGO_PKG_VERSION"), keyframes: Vec::new() };
    println!("{} [{}, {}]", gpu.adapter.name, gpu.adapter.kind, gpu.adapter.driver);
    for &(width, height) in &args.size {
        for &gaussians in &args.gaussians {
            let bench = HostBench { gaussians, width, height, keyframes: args.keyframes };
            let measured = bench_host(&gpu, bench).into_diagnostic()?;
            print(&measured);
            report.keyframes.push(measured);
        }
    }
    if let Some(path) = &args.out {
        let text = serde_json::to_string_pretty(&report).into_diagnostic()?;
        keysplat::files::write_atomically(path, text.as_bytes()).into_diagnostic()?;
    }
    Ok(())
}

fn print(report: &HostReport) {
    let bench = &report.bench;
    println!("\n{} Gaussians, {}x{}: each keyframe", bench.gaussians, bench.width, bench.height);
    for (part, ms) in &report.parts_ms {
        println!("  {part:<12}{ms:>9.2} ms");
    }
    println!("  {:<12}{:>9.2} ms CPU of the mapping thread", "all", report.total_ms);
    println!("  waits {}   read back {:.2} MB   uploads {}", report.waits, report.bytes_read as f64 * 1e-6, report.uploads);
}
