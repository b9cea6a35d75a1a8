//! `keysplat check`: what a recording holds and what in it looks wrong, before a run.

use std::path::PathBuf;

use clap::Args;
use keysplat::inspection::inspect;
use keysplat::sequence::Sequence;
use miette::{IntoDiagnostic, miette};

use super::source::SourceArgs;
use super::{Verbosity, print};

#[derive(Args)]
pub struct CheckArgs {
    /// Folder of the recording, or a video.
    sequence: PathBuf,
    #[command(flatten)]
    source: SourceArgs,
}

pub fn check(args: &CheckArgs, verbosity: Verbosity) -> miette::Result<()> {
    let SourceArgs { layout, sensor, camera } = &args.source;
    let mut sequence = Sequence::open(&args.sequence, *layout, camera.as_deref()).into_diagnostic()?;
    if let Some(kind) = *sensor {
        sequence.restrict_to(kind).into_diagnostic()?;
    }
    let found = inspect(&sequence).into_diagnostic()?;
    if verbosity.json {
        print(&format!("{}\n", serde_json::to_string(&found).into_diagnostic()?))?;
    } else if !verbosity.quiet {
        print(&found.to_string())?;
    }
    match found.problems() {
        0 => Ok(()),
        1 => Err(miette!("1 problem makes a run useless")),
        n => Err(miette!("{n} problems make a run useless")),
    }
}
