//! `keysplat generate`

use std::path::{Path, PathBuf};

use clap::Args;
use indicatif::ProgressBar;
use keysplat::sequence::synthetic::{self, SceneConfig};
use miette::IntoDiagnostic;

use super::{Verbosity, progress};

#[derive(Args)]
pub struct GenerateArgs {
    /// Scene description (see `sequences/`).
    scene: PathBuf,
    /// Folder to write the recording to, in TUM's layout.
    #[arg(short, long)]
    out: PathBuf,
}

pub fn generate(args: &GenerateArgs, verbosity: Verbosity) -> miette::Result<()> {
    let scene = SceneConfig::read(&args.scene).into_diagnostic()?;
    render(&scene, &args.out, verbosity)
}

/// Renders a scene with a progress bar.
pub fn render(scene: &SceneConfig, out: &Path, verbosity: Verbosity) -> miette::Result<()> {
    let bar: ProgressBar = progress::bar(verbosity, 0, "rendering {wide_bar} {pos}/{len} frames  {eta} left");
    let on_frame = |done: usize, total: usize| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    };
    let result = synthetic::generate(scene, out, &on_frame).into_diagnostic();
    bar.finish_and_clear();
    result
}
