//! `keysplat resume`

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Args;
use keysplat::pipeline::{Checkpoint, outputs};
use miette::{IntoDiagnostic, miette};

use super::{Verbosity, print, progress, run};

#[derive(Args)]
pub struct ResumeArgs {
    /// Folder of a run that was begun with --checkpoint-every.
    dir: PathBuf,
}

pub fn resume(args: ResumeArgs, verbosity: Verbosity) -> miette::Result<()> {
    let (dir, path) = (&args.dir, args.dir.join(outputs::CHECKPOINT));
    if !path.exists() && dir.join(outputs::METRICS).exists() {
        return print(&format!("The run in {} is finished; there is nothing to resume.\n", dir.display()));
    }
    if !path.exists() {
        let advice = "give the folder of a run that was begun with keysplat run --checkpoint-every";
        return Err(miette!("there is no {}; {advice}", path.display()));
    }
    let checkpoint = Checkpoint::read(&path).into_diagnostic()?;
    let config = checkpoint.config().into_diagnostic()?;
    let stop = Arc::new(AtomicBool::new(false));
    progress::stop_on_ctrl_c(&stop)?;
    run::replay(config, args.dir, Some(checkpoint), stop, verbosity)
}
