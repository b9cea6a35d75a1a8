//! `keysplat resume`

use std::path::PathBuf;

use clap::Args;
use keysplat::Session;
use keysplat::run_folder::outputs;
use miette::IntoDiagnostic;

use super::view::ViewOptions;
use super::{Verbosity, print, run};

#[derive(Args)]
pub struct ResumeArgs {
    /// Folder of a run that was begun with --checkpoint-every.
    dir: PathBuf,
    /// The recording, where it has moved.
    #[arg(long)]
    sequence: Option<PathBuf>,
    #[command(flatten)]
    view: ViewOptions,
}

pub fn resume(args: &ResumeArgs, verbosity: Verbosity) -> miette::Result<()> {
    if !args.dir.join(outputs::CHECKPOINT).exists() && args.dir.join(outputs::METRICS).exists() {
        return print(&format!("The run in {} is finished; there is nothing to resume.\n", args.dir.display()));
    }
    run::replay(Session::resume(&args.dir, args.sequence.as_deref()).into_diagnostic()?, &args.view, verbosity)
}
