//! `keysplat split`: a plan of tasks that refine a large map in parts.

use std::path::PathBuf;

use clap::Args;
use keysplat::jobs::{CellTask, Draft, Task, Work};
use keysplat::session::{Cell, SplitOptions, split_run};
use miette::{IntoDiagnostic, miette};

use super::jobs;

#[derive(Args)]
pub struct SplitArgs {
    /// Folder of a finished run.
    run: PathBuf,
    /// Folder of the plan, for `keysplat jobs`.
    #[arg(short, long)]
    out: PathBuf,
    /// Largest extent of the cameras in a cell, metres.
    #[arg(long, default_value_t = 10.0)]
    size: f32,
    /// Width of the surroundings that are refined with a cell and left out of the result, metres.
    #[arg(long, default_value_t = 2.0)]
    halo: f32,
    /// Most Gaussians of a cell: one with more is divided at their median.
    #[arg(long, default_value_t = 1_500_000)]
    max_gaussians: usize,
    /// Options of `keysplat run --refine` for all cells, e.g. -- --set mapping.refine.final_epochs=30
    #[arg(last = true)]
    options: Vec<String>,
}

pub fn split(args: &SplitArgs) -> miette::Result<()> {
    let SplitArgs { size, halo, max_gaussians, .. } = *args;
    if !(size.is_finite() && size > 0.0 && halo.is_finite() && halo >= 0.0 && max_gaussians > 0) {
        return Err(miette!("--size and --max-gaussians must be positive, and --halo zero or more"));
    }
    let found = split_run(&args.run, &SplitOptions { size, halo, max_gaussians }).into_diagnostic()?;
    let mut draft = Draft::new(&args.out).into_diagnostic()?;
    let mut inputs = Vec::new();
    let read = jobs::inputs_of_run(&found.recording, &jobs::refining(&args.run, &args.options))?;
    // Of the run's folder, single files: the others may change.
    for file in read.iter().filter(|path| **path != found.run).chain(&found.files) {
        inputs.push(draft.input(file).into_diagnostic()?);
    }
    let (run, recording) = (draft.place(&args.run).into_diagnostic()?, draft.place(&found.recording).into_diagnostic()?);
    for Cell { region, gaussians, keyframes } in found.cells {
        tracing::info!(gaussians, keyframes, "cell {region}");
        let task = CellTask { run: run.clone(), recording: recording.clone(), region, options: args.options.clone() };
        draft.task(Task { name: region.to_string(), seed: 0, inputs: inputs.clone(), work: Work::Cell(task) });
    }
    jobs::print_plan(&draft.finish().into_diagnostic()?)
}
