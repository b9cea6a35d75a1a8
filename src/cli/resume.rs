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
    /// The recording, where it has moved.
    #[arg(long)]
    sequence: Option<PathBuf>,
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
    let mut config = checkpoint.config().into_diagnostic()?;
    let sequence = config.sequence.get_or_insert_default();
    if let Some(path) = &args.sequence {
        // Absolute, so that the next checkpoint finds it from anywhere.
        sequence.path = std::path::absolute(path).into_diagnostic()?;
    } else if !sequence.path.exists() {
        return Err(miette!("the recording is no longer at {}; name its new place with --sequence", sequence.path.display()));
    }
    let stop = Arc::new(AtomicBool::new(false));
    progress::stop_on_ctrl_c(&stop)?;
    run::replay(config, args.dir, Some(checkpoint), stop, verbosity)
}
