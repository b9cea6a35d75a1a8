//! `keysplat eval`: measures a folder with `trajectory.txt` and `map.ply`, whoever made them.

use std::path::PathBuf;

use clap::Args;
use keysplat::session::{EvaluateOptions, evaluate_folder};
use miette::IntoDiagnostic;

use super::{Verbosity, print_metrics, progress};

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
    let options = EvaluateOptions { sequence: args.sequence.clone(), map_scale: args.map_scale, adapter: args.adapter.clone() };
    let bar = progress::spinner(verbosity, "{spinner} {pos} views compared");
    let metrics = evaluate_folder(&args.dir, &options, &|views| bar.set_position(views as u64));
    bar.finish_and_clear();
    print_metrics(&metrics.into_diagnostic()?, verbosity)
}
