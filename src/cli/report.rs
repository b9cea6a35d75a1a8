//! `keysplat report`: a run's folder as one HTML file.

use std::path::PathBuf;

use clap::Args;
use keysplat::report;
use miette::IntoDiagnostic;

use super::{Verbosity, print};

#[derive(Args)]
pub struct ReportArgs {
    /// Folder of a run.
    dir: PathBuf,
}

pub fn report(args: &ReportArgs, verbosity: Verbosity) -> miette::Result<()> {
    let path = report::write(&args.dir).into_diagnostic()?;
    if verbosity.quiet { Ok(()) } else { print(&format!("{}\n", path.display())) }
}
