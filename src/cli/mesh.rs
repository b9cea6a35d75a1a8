//! `keysplat mesh`: the surface of a finished run as a triangle mesh.

use std::path::PathBuf;

use clap::Args;
use keysplat::mesh::{DepthSource, MeshConfig, MeshFormat};
use keysplat::session::{MapDepth, MeshOptions, mesh_folder};
use miette::IntoDiagnostic;

use super::run::parse_bytes;
use super::{Verbosity, print, progress};

#[derive(Args)]
pub struct MeshArgs {
    /// Folder of a run.
    dir: PathBuf,
    /// File to write; its ending is the format: .ply, .glb or .obj.
    out: PathBuf,
    /// Side of a voxel, metres.
    #[arg(long, default_value_t = MeshConfig::default().voxel_metres)]
    voxel: f64,
    /// Depth that is fused. By default the sensor's, and the map's where there is none.
    #[arg(long, value_enum)]
    depth: Option<DepthSource>,
    /// How the map's depth is blended. By default plane where the run has mapping.surface = "planar", else centre.
    #[arg(long, value_enum)]
    map_depth: Option<MapDepth>,
    /// Fuse every posed frame, not the keyframes alone.
    #[arg(long)]
    all_frames: bool,
    /// Fuse every n-th of them.
    #[arg(long, default_value_t = 1)]
    every: usize,
    /// Resolution of the views as a share of the recorded one; the map's by default.
    #[arg(long)]
    scale: Option<f64>,
    /// Distances are truncated at so many voxels.
    #[arg(long, default_value_t = MeshConfig::default().truncation_voxels)]
    truncation: f64,
    /// Views disagree where their depths differ by more than this share.
    #[arg(long, default_value_t = MeshConfig::default().tolerance)]
    tolerance: f64,
    /// Views that each view is compared with.
    #[arg(long, default_value_t = MeshConfig::default().neighbours)]
    neighbours: usize,
    /// Views that must have seen a place.
    #[arg(long, default_value_t = MeshConfig::default().min_views)]
    min_views: u16,
    /// Keep connected components whose area is at least this share of the largest one's: 1 keeps the largest alone, 0 all.
    #[arg(long, default_value_t = MeshConfig::default().min_component_share)]
    min_component: f64,
    /// Collapse edges until at most this share of the triangles is left.
    #[arg(long, value_name = "RATIO")]
    simplify: Option<f64>,
    /// Most memory for views and voxels, e.g. 500M or 2G.
    #[arg(long, value_parser = parse_bytes, default_value = "4G")]
    max_memory: u64,
    /// The recording, where the folder does not name it or it has moved.
    #[arg(long)]
    sequence: Option<PathBuf>,
    /// Part of the name of the adapter to use.
    #[arg(long)]
    adapter: Option<String>,
}

impl MeshArgs {
    fn options(&self) -> MeshOptions {
        let mesh = MeshConfig {
            voxel_metres: self.voxel,
            truncation_voxels: self.truncation,
            tolerance: self.tolerance,
            neighbours: self.neighbours,
            min_views: self.min_views,
            min_component_share: self.min_component,
            simplify: self.simplify,
            max_memory_bytes: self.max_memory,
        };
        let Self { depth, map_depth, all_frames, every, scale, .. } = *self;
        let (sequence, adapter) = (self.sequence.clone(), self.adapter.clone());
        MeshOptions { mesh, depth, map_depth, all_frames, every, scale, sequence, adapter }
    }
}

pub fn mesh(args: &MeshArgs, verbosity: Verbosity) -> miette::Result<()> {
    let format = MeshFormat::of_path(&args.out).into_diagnostic()?;
    let bar = progress::bar(verbosity, 0, "{msg} {wide_bar} {pos}/{len}");
    bar.set_message("rendering views");
    let on_view = |done: usize, all: usize| {
        bar.set_length(all as u64);
        bar.set_position(done as u64);
    };
    let fused = mesh_folder(&args.dir, &args.options(), &on_view, &|stage| bar.set_message(stage));
    bar.finish_and_clear();
    let fused = fused.into_diagnostic()?;
    let bytes = format.write(&fused.mesh, &args.out).into_diagnostic()?;
    if verbosity.quiet {
        return Ok(());
    }
    let (triangles, area) = (fused.mesh.triangles.len(), fused.mesh.area());
    let views = format!("{} views, {} with measured depth", fused.views, fused.measured);
    print(&format!(
        "{}: {triangles} triangles, {area:.1} m², {:.1} MiB, of {views}\n",
        args.out.display(),
        bytes as f64 / f64::from(1 << 20)
    ))
}
