//! `keysplat export`: a map in another file format or in levels of detail, whole or in part; a run's images and poses for other programs.

mod target;

use std::path::{Path, PathBuf};

use clap::Args;
use glam::Vec3;
use keysplat::export::dataset::DatasetFormat;
use keysplat::export::lod::{DISTANCE_FACTOR, Levels};
use keysplat::export::{ExportFilter, MapFormat};
use keysplat::files::write_atomically;
use keysplat::geometry::{Se3, Trajectory};
use keysplat::run_folder::outputs;
use keysplat::session::{DatasetCounts, DatasetOptions, DatasetViews, export_dataset};
use keysplat::splat::{GaussianCloud, ShDegree};
use miette::{IntoDiagnostic, miette};
use target::Target;

use super::{Verbosity, print, progress};

#[derive(Args)]
pub struct ExportArgs {
    /// Folder of a run, or, for a map in another format, a map.
    map: PathBuf,
    /// File to write; its ending is the format: .ply, .spz, .sog or .glb. For a dataset or levels of detail, a new folder.
    out: PathBuf,
    /// Format, where the ending does not say it.
    #[arg(long, value_enum)]
    format: Option<Target>,
    /// Levels of detail in a folder; the same as --format lod.
    #[arg(long, conflicts_with = "format")]
    lod: bool,
    /// Images of a dataset.
    #[arg(long, value_enum, default_value_t = DatasetViews::Keyframes)]
    views: DatasetViews,
    /// The recording, where it has moved; its images are part of a dataset.
    #[arg(long)]
    sequence: Option<PathBuf>,
    /// Most Gaussians: those that cover most are kept.
    #[arg(long)]
    max_gaussians: Option<usize>,
    /// Leave out Gaussians that are less opaque, e.g. 0.05.
    #[arg(long, value_parser = parse_share)]
    min_opacity: Option<f32>,
    /// Highest degree of the spherical harmonics, 0 to 3.
    #[arg(long, value_parser = parse_degree)]
    sh_degree: Option<ShDegree>,
    /// Keep the box between two corners, metres in the world of the map.
    #[arg(long, value_name = "X,Y,Z:X,Y,Z", value_parser = parse_box, allow_hyphen_values = true)]
    crop: Option<(Vec3, Vec3)>,
}

fn parse_share(text: &str) -> Result<f32, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| format!("`{text}` is no number from 0 to 1"))
}

fn parse_degree(text: &str) -> Result<ShDegree, String> {
    text.parse().ok().and_then(ShDegree::new).ok_or_else(|| format!("`{text}` is no degree; write 0, 1, 2 or 3"))
}

fn parse_box(text: &str) -> Result<(Vec3, Vec3), String> {
    let wrong = || format!("`{text}` is no box; write two corners, like -1,-1,0:1,1,3, the lower one first");
    let corner = |text: &str| {
        let numbers: Vec<f32> = text.split(',').map(|part| part.trim().parse().ok()).collect::<Option<_>>()?;
        <[f32; 3]>::try_from(numbers).ok().map(Vec3::from).filter(|corner| corner.is_finite())
    };
    let (low, high) = text.split_once(':').ok_or_else(wrong)?;
    let (low, high) = corner(low).zip(corner(high)).ok_or_else(wrong)?;
    if low.cmple(high).all() { Ok((low, high)) } else { Err(wrong()) }
}

impl ExportArgs {
    fn filter(&self) -> ExportFilter {
        let Self { crop, min_opacity, max_gaussians, sh_degree, .. } = *self;
        ExportFilter { crop, min_opacity, max_gaussians, sh_degree }
    }
}

/// The map of a run's folder, or of a file.
fn find(path: &Path) -> miette::Result<(PathBuf, MapFormat)> {
    let known = || {
        let mut endings: Vec<String> = MapFormat::all().iter().map(|format| format!(".{}", format.extension())).collect();
        endings.sort();
        endings.dedup();
        endings.join(", ")
    };
    outputs::find_map(path)
        .ok_or_else(|| miette!("{} is no map; give the folder of a run, or a file of {}", path.display(), known()))
}

/// Poses of a run's keyframes; none where only a map is there.
fn cameras(path: &Path) -> Vec<Se3> {
    let folder = if path.is_dir() { path } else { path.parent().unwrap_or(path) };
    let keyframes = Trajectory::read_tum(&folder.join(outputs::KEYFRAMES)).unwrap_or_default();
    keyframes.poses.iter().map(|pose| pose.world_from_camera).collect()
}

pub fn export(args: &ExportArgs, verbosity: Verbosity) -> miette::Result<()> {
    let named = if args.lod { Some(Target::Levels) } else { args.format };
    let to = named.or_else(|| Target::of_path(&args.out));
    let unknown = || {
        miette!("{} does not say its format; end it in .ply, .spz, .sog or .glb, or name one with --format", args.out.display())
    };
    let done = match to.ok_or_else(unknown)? {
        Target::Map(format) => export_map(args, format)?,
        Target::Levels => export_levels(args)?,
        Target::Dataset(format) => export_images(args, format, verbosity)?,
        Target::Kitti => export_poses(args)?,
    };
    if verbosity.quiet { Ok(()) } else { print(&format!("{done}\n")) }
}

/// What the filters leave of a map.
fn read_part(args: &ExportArgs, path: &Path, format: MapFormat) -> miette::Result<GaussianCloud> {
    let cloud = format.read(path).into_diagnostic()?;
    let part = args.filter().apply(&cloud);
    if part.is_empty() {
        return Err(miette!("of {} Gaussians, none passes; widen --crop or lower --min-opacity", cloud.len()));
    }
    Ok(part)
}

fn export_map(args: &ExportArgs, to: MapFormat) -> miette::Result<String> {
    let (path, from) = find(&args.map)?;
    let same = |path: &Path| std::fs::canonicalize(path).ok();
    if same(&args.out).is_some_and(|out| Some(out) == same(&path)) {
        return Err(miette!("{} is the map that is exported; choose another file", path.display()));
    }
    let part = read_part(args, &path, from)?;
    if part.antialiased && !to.keeps_antialiasing() {
        tracing::warn!(
            "{} has no place for antialiasing: viewers will draw small Gaussians too opaque; .ply, .spz and .sog keep it",
            to.name()
        );
    }
    let bytes = to.write_for(&part, &cameras(&args.map), &args.out).into_diagnostic()?.len();
    Ok(format!("{}: {} Gaussians, {:.1} MiB", args.out.display(), part.len(), bytes as f64 / f64::from(1 << 20)))
}

/// The folder to write, which may be named by its main file.
fn folder_of(out: &Path, target: Target) -> &Path {
    let folder = if Target::of_path(out) == Some(target) { out.parent().unwrap_or(Path::new("")) } else { out };
    if folder.as_os_str().is_empty() { Path::new(".") } else { folder }
}

/// The map in levels of detail; `lod-meta.json` may be named instead of its folder.
fn export_levels(args: &ExportArgs) -> miette::Result<String> {
    if MapFormat::of_path(&args.out).is_some() {
        return Err(miette!("{} names a file; levels of detail are a folder: leave out the ending", args.out.display()));
    }
    let folder = folder_of(&args.out, Target::Levels);
    let (path, from) = find(&args.map)?;
    let levels = Levels::new(&read_part(args, &path, from)?);
    let bytes = levels.write(&cameras(&args.map), folder).into_diagnostic()?;
    let counts: Vec<String> = levels.counts().iter().map(usize::to_string).collect();
    let advice = levels
        .base_distance()
        .map_or(String::new(), |metres| format!("; for viewers: lodBaseDistance {metres:.1}, lodMultiplier {DISTANCE_FACTOR}"));
    let size = bytes as f64 / f64::from(1 << 20);
    Ok(format!("{}: {} Gaussians by level, {size:.1} MiB{advice}", folder.display(), counts.join(", ")))
}

/// A dataset of the run's images; `transforms.json` may be named instead of its folder.
fn export_images(args: &ExportArgs, format: DatasetFormat, verbosity: Verbosity) -> miette::Result<String> {
    let folder = folder_of(&args.out, Target::Dataset(format));
    let options = DatasetOptions { format, views: args.views, points: args.filter(), sequence: args.sequence.clone() };
    let bar = progress::spinner(verbosity, "{spinner} {pos} images");
    let counts = export_dataset(&args.map, folder, &options, &|images| bar.set_position(images as u64));
    bar.finish_and_clear();
    let DatasetCounts { images, points, unreadable } = counts.into_diagnostic()?;
    let left_out = if unreadable > 0 { format!(", {unreadable} left out that cannot be read") } else { String::new() };
    Ok(format!("{}: {images} images{left_out}, {points} points", folder.display()))
}

fn export_poses(args: &ExportArgs) -> miette::Result<String> {
    let trajectory = Trajectory::read_tum(&args.map.join(outputs::TRAJECTORY)).into_diagnostic()?;
    write_atomically(&args.out, trajectory.to_kitti().as_bytes()).into_diagnostic()?;
    Ok(format!("{}: {} poses, one a line, without those of lost frames", args.out.display(), trajectory.poses.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_have_two_corners() {
        assert_eq!(parse_box("-1,-2,0:1, 2,3"), Ok((Vec3::new(-1.0, -2.0, 0.0), Vec3::new(1.0, 2.0, 3.0))));
        for wrong in ["", "1,2,3", "1,2:3,4", "1,1,1:0,2,2", "nan,0,0:1,1,1", "0,0,0:1,1,inf"] {
            assert!(parse_box(wrong).is_err(), "{wrong}");
        }
        assert!(parse_share("0.5").is_ok() && parse_share("1.5").is_err() && parse_share("nan").is_err());
        assert!(parse_degree("2").is_ok() && parse_degree("4").is_err());
    }
}
