//! `keysplat check`: what a recording holds and what in it looks wrong, before a run.

use std::path::PathBuf;

use clap::Args;
use keysplat::inspection::inspect;
use keysplat::sequence::{Layout, SensorKind, Sequence};
use miette::{IntoDiagnostic, miette};

use super::{Verbosity, print};

#[derive(Args)]
pub struct CheckArgs {
    /// Folder of the recording, or a video.
    sequence: PathBuf,
    /// Dataset layout, where it is not recognised.
    #[arg(long, value_enum)]
    layout: Option<Layout>,
    /// Use of the recording only what a sensor of this kind gives.
    #[arg(long, value_enum)]
    sensor: Option<SensorKind>,
    /// Camera preset to use instead of the recording's own calibration; for a video, or the path of a camera.toml.
    #[arg(long)]
    camera: Option<String>,
}

pub fn check(args: &CheckArgs, verbosity: Verbosity) -> miette::Result<()> {
    let mut sequence = Sequence::open(&args.sequence, args.layout, args.camera.as_deref()).into_diagnostic()?;
    if let Some(kind) = args.sensor {
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
        n => Err(miette!(
            "{n} {} {} a run useless",
            if n == 1 { "problem" } else { "problems" },
            if n == 1 { "makes" } else { "make" }
        )),
    }
}
