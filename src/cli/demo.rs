//! `keysplat demo`: the synthetic room, rendered on first use, then mapped.

use std::path::PathBuf;

use clap::Args;
use keysplat::{Config, SceneConfig, Session};
use miette::IntoDiagnostic;

use super::view::ViewOptions;
use super::{Verbosity, generate, print, run};

const SCENE: &str = include_str!("../../sequences/demo.toml");
/// The demo maps at half of its recorded size, which two cores without a GPU can do in a few minutes.
const MAP_SCALE: f64 = 0.5;

#[derive(Args)]
pub struct DemoArgs {
    /// Folder for the results; the recording is kept in `<out>/demo-room`.
    #[arg(short, long, default_value = "out/demo")]
    out: PathBuf,
    #[command(flatten)]
    view: ViewOptions,
}

pub fn demo(args: &DemoArgs, verbosity: Verbosity) -> miette::Result<()> {
    let scene: SceneConfig = toml::from_str(SCENE).into_diagnostic()?;
    let recording = args.out.join("demo-room");
    generate::render_if_changed(&scene, &recording, verbosity)?;
    let config = Config { map_scale: MAP_SCALE, ..Config::for_recording(&recording) };
    run::replay(Session::open(config, &args.out).into_diagnostic()?, &args.view, verbosity)?;
    if !verbosity.shows_progress() {
        return Ok(());
    }
    let (map, views) = (args.out.join("map.ply"), args.out.join("views"));
    let program = std::env::current_exe().unwrap_or_else(|_| "keysplat".into());
    print(&format!(
        "\nTo look at the map and the camera's path in a browser: {} view {}\n\
         The map is {}; it opens in any viewer of Gaussian splats, too.\n\
         Held-out views beside their renders are in {}.\n",
        program.display(),
        args.out.display(),
        map.display(),
        views.display()
    ))
}
