//! `keysplat generate`

use std::path::{Path, PathBuf};

use clap::Args;
use indicatif::ProgressBar;
use keysplat::mesh::MeshFormat;
use keysplat::synthetic::{self, SceneConfig};
use miette::IntoDiagnostic;

use super::{Verbosity, progress};

#[derive(Args)]
pub struct GenerateArgs {
    /// Scene description (see `sequences/`).
    scene: PathBuf,
    /// Folder to write the recording to, in TUM's layout, or in KITTI's if it is stereo.
    #[arg(short, long, required_unless_present = "surface")]
    out: Option<PathBuf>,
    /// Mesh to write the exact surface to, as far as the camera sees it: .ply, .glb or .obj.
    #[arg(long)]
    surface: Option<PathBuf>,
}

pub fn generate(args: &GenerateArgs, verbosity: Verbosity) -> miette::Result<()> {
    let scene = SceneConfig::read(&args.scene).into_diagnostic()?;
    if let Some(path) = &args.surface {
        let format = MeshFormat::of_path(path).into_diagnostic()?;
        format.write(&synthetic::visible_surface(&scene).into_diagnostic()?, path).into_diagnostic()?;
    }
    args.out.as_ref().map_or(Ok(()), |out| render(&scene, out, verbosity))
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

/// Says in the recording's folder which scene was rendered.
const DIGEST_FILE: &str = "digest.txt";

/// Renders a scene unless it lies there already.
pub fn render_if_changed(scene: &SceneConfig, recording: &Path, verbosity: Verbosity) -> miette::Result<()> {
    let digest_file = recording.join(DIGEST_FILE);
    if std::fs::read_to_string(&digest_file).is_ok_and(|digest| digest == scene.digest()) {
        return Ok(());
    }
    if recording.exists() {
        std::fs::remove_dir_all(recording).into_diagnostic()?;
    }
    render(scene, recording, verbosity)?;
    std::fs::write(&digest_file, scene.digest()).into_diagnostic()
}
