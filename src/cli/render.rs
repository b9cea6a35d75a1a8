//! `keysplat render`: a moving picture of a map, by our rasterizer.

use std::path::PathBuf;

use clap::Args;
use keysplat::Gpu;
use keysplat::evaluation::views::to_rgb8;
use keysplat::film::{CameraPathKind, Film, poses};
use keysplat::geometry::{Pinhole, Trajectory};
use keysplat::render::MapRenderer;
use keysplat::run_folder::outputs;
use keysplat::splat::ViewCamera;
use keysplat::splat::model::Surface;
use keysplat::{Config, Recording};
use miette::{IntoDiagnostic, miette};

use super::bench::parse_size;
use super::{Verbosity, print, progress};

#[derive(Args)]
pub struct RenderArgs {
    /// Folder of a run.
    dir: PathBuf,
    /// Where the camera goes.
    #[arg(long, value_enum, default_value_t = CameraPathKind::Trajectory)]
    path: CameraPathKind,
    /// File to write: .mp4, .gif, or .png for numbered pictures.
    #[arg(short, long)]
    out: PathBuf,
    /// Size of the picture; that of the mapped views by default.
    #[arg(long, value_parser = parse_size)]
    size: Option<(u32, u32)>,
    /// Length.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Frames a second; 30, or 12 for a GIF.
    #[arg(long)]
    fps: Option<f64>,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

const MOST_FRAMES: f64 = 100_000.0;

pub fn render(args: &RenderArgs, verbosity: Verbosity) -> miette::Result<()> {
    let (map, format) =
        outputs::find_map(&args.dir).ok_or_else(|| miette!("{} has no map; give the folder of a run", args.dir.display()))?;
    let cloud = format.read(&map).into_diagnostic()?;
    let pinhole = pinhole(args);
    let is_gif = args.out.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("gif"));
    let fps = args.fps.unwrap_or(if is_gif { 12.0 } else { 30.0 });
    let frames = (args.seconds * fps).round();
    if !(fps > 0.0 && (1.0..=MOST_FRAMES).contains(&frames)) {
        return Err(miette!("{} seconds of {fps} frames a second are no film; choose other --seconds and --fps", args.seconds));
    }
    let trajectory = |name: &str| Trajectory::read_tum(&args.dir.join(name)).into_diagnostic();
    let (path, keyframes) = (trajectory(outputs::TRAJECTORY)?, trajectory(outputs::KEYFRAMES).unwrap_or_default());
    let poses = poses(args.path, &path, &keyframes, frames as usize);
    if poses.is_empty() {
        return Err(miette!("{} has no poses", args.dir.join(outputs::TRAJECTORY).display()));
    }
    let gpu = Gpu::open(args.adapter.as_deref()).into_diagnostic()?;
    let mut renderer = MapRenderer::new(&gpu, &cloud, Surface::Volume, usize::MAX).into_diagnostic()?;
    let mut film = Film::create(&args.out, (pinhole.width, pinhole.height), fps).into_diagnostic()?;
    let bar = progress::bar(verbosity, poses.len() as u64, "{wide_bar} {pos}/{len} frames");
    for world_from_camera in poses {
        let camera = ViewCamera { pinhole, camera_from_world: world_from_camera.inverse() };
        let rendered = renderer.render(&camera).into_diagnostic()?;
        film.append(&to_rgb8(&rendered)).into_diagnostic()?;
        bar.inc(1);
    }
    film.finish().into_diagnostic()?;
    bar.finish_and_clear();
    if verbosity.quiet { Ok(()) } else { print(&format!("{}\n", args.out.display())) }
}

/// The camera of the mapped views at the wanted size: the same view, and more along the longer side. Sides are even, as video encoders want them.
fn pinhole(args: &RenderArgs) -> Pinhole {
    let config = Config::read(&args.dir.join(outputs::CONFIG)).ok();
    let recorded = config.and_then(|config| Recording::open(config).ok()).map(|recording| recording.map_pinhole());
    let recorded = recorded.unwrap_or_else(Pinhole::assumed);
    let (width, height) = args.size.unwrap_or((recorded.width, recorded.height));
    let (width, height) = (width & !1, height & !1);
    let scale = (f64::from(width) / f64::from(recorded.width)).min(f64::from(height) / f64::from(recorded.height));
    let centre =
        |side: u32, recorded: u32, c: f64| 0.5 * (f64::from(side) - 1.0) + scale * (c - 0.5 * (f64::from(recorded) - 1.0));
    Pinhole {
        fx: scale * recorded.fx,
        fy: scale * recorded.fy,
        cx: centre(width, recorded.width, recorded.cx),
        cy: centre(height, recorded.height, recorded.cy),
        width,
        height,
    }
}
