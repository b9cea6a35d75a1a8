//! A triangle mesh of a map: depth of many views is fused into a signed distance, whose zero is the surface.
//!
//! Curless & Levoy, *A volumetric method for building complex models from range images*, 1996; sparse blocks as in Nießner et al.,
//! *Real-time 3D reconstruction at scale using voxel hashing*, 2013. `view` prepares depth images, `consistency` leaves out what other
//! views contradict, `volume` and `integrate` fuse them, `marching` extracts the surface, `components` and `simplify` tidy it.
//! `formats` has the files, `compare` the errors against a true surface. Left out: textures, and surfaces that no view saw.

mod compare;
mod components;
mod config;
mod consistency;
mod depth_errors;
mod formats;
mod integrate;
mod marching;
mod ply;
mod simplify;
mod tables;
mod view;
mod volume;

use std::path::PathBuf;

use glam::Vec3;
use rayon::prelude::*;

pub use compare::{MeshErrors, SurfaceShare, compare, refine_alignment};
pub use components::keep_components;
pub use config::{DepthSource, MeshConfig};
pub use depth_errors::{DepthErrors, compare_depth};
pub use formats::MeshFormat;
pub use simplify::simplify;
pub use view::DepthView;

use crate::files::WriteError;
use volume::Volume;

/// Triangles with colours at their corners.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// `[N, 3]` world, metres.
    pub vertices: Vec<Vec3>,
    /// `[N, 3]` sRGB.
    pub colors: Vec<[u8; 3]>,
    /// `[M, 3]` indices into the vertices, counter-clockwise for one who looks at the surface from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Area, square metres.
    pub fn area(&self) -> f64 {
        self.triangles.iter().map(|triangle| self.triangle_area(triangle)).sum()
    }

    /// Area of a triangle, square metres.
    fn triangle_area(&self, triangle: &[u32; 3]) -> f64 {
        let [a, b, c] = triangle.map(|i| self.vertices[i as usize].as_dvec3());
        0.5 * (b - a).cross(c - a).length()
    }

    /// Drops vertices that no triangle uses; the others keep their order.
    pub fn without_loose_vertices(self) -> Self {
        let mut place = vec![u32::MAX; self.vertices.len()];
        self.triangles.iter().flatten().for_each(|i| place[*i as usize] = 0);
        let mut kept = Self::default();
        for (i, slot) in place.iter_mut().enumerate().filter(|(_, slot)| **slot == 0) {
            *slot = kept.vertices.len() as u32;
            kept.vertices.push(self.vertices[i]);
            kept.colors.push(self.colors[i]);
        }
        kept.triangles = self.triangles.iter().map(|triangle| triangle.map(|i| place[i as usize])).collect();
        kept
    }
}

/// A mesh that cannot be made, read or written.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    /// There is nothing to fuse.
    #[error(
        "no surface is left: too few views see the same place; lower --min-views, raise --tolerance, take --all-frames, or map the recording with more keyframes"
    )]
    Empty,
    /// A setting is out of its range.
    #[error("--{option} is {value}; {advice}")]
    Option {
        /// Its name on the command line.
        option: &'static str,
        /// Its value.
        value: f64,
        /// Range or advice.
        advice: &'static str,
    },
    /// The blocks do not fit.
    #[error(
        "with voxels of {voxel} m the surface needs at least {needed_mib} MiB, but --max-memory leaves {available_mib} MiB; --voxel {fits} fits"
    )]
    TooLarge {
        /// Asked for, metres.
        voxel: f64,
        /// Needed by all blocks, or by those counted until it was too much.
        needed_mib: u64,
        /// Left for blocks.
        available_mib: u64,
        /// The voxel size that fits, metres.
        fits: f64,
    },
    /// The views alone do not fit.
    #[error(
        "the depth of {views} views needs {needed_mib} MiB, more than --max-memory; raise it, or take fewer views with --every"
    )]
    TooManyViews {
        /// Number of views.
        views: usize,
        /// Needed by them.
        needed_mib: u64,
    },
    /// A surface that cannot be compared.
    #[error("one of the two surfaces has no area, so there is nothing to compare; give meshes with triangles")]
    NoArea,
    /// An ending that is no format.
    #[error("{path} ends in no known format of meshes; choose .ply, .glb or .obj")]
    Format {
        /// The path.
        path: PathBuf,
    },
    /// More than the format can hold.
    #[error("the mesh is too large for {path}: {reason}; raise --voxel or choose .ply")]
    TooLargeForFormat {
        /// The path.
        path: PathBuf,
        /// The limit.
        reason: &'static str,
    },
    /// A file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file is damaged, or is no mesh.
    #[error("{path} is no mesh that can be read: {what}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Fuses views into a mesh: the same bits for the same views, however many threads there are. `on_stage` receives the name of each stage.
///
/// # Errors
/// [`MeshError`] if a setting is out of range, the blocks do not fit into the memory, or no surface is left.
pub fn fuse(mut views: Vec<DepthView>, config: &MeshConfig, on_stage: &dyn Fn(&'static str)) -> Result<Mesh, MeshError> {
    config.validate()?;
    let bytes: u64 = views.iter().map(DepthView::bytes).sum();
    if bytes >= config.max_memory_bytes {
        return Err(MeshError::TooManyViews { views: views.len(), needed_mib: bytes >> 20 });
    }
    on_stage("checking views against each other");
    consistency::check(&mut views, config);
    on_stage("estimating memory");
    let keys = volume::fitting_blocks(&views, config, config.max_memory_bytes - bytes)?;
    on_stage("fusing");
    let mut volume = Volume::new(config.voxel_metres, &keys);
    let prepared: Vec<integrate::Projection<'_>> = views.iter().map(|view| integrate::Projection::new(view, config)).collect();
    volume.blocks.par_iter_mut().for_each(|block| prepared.iter().for_each(|view| view.integrate(block)));
    drop(prepared);
    drop(views);
    on_stage("extracting the surface");
    let mesh = marching::extract(&volume, config.min_views);
    drop(volume);
    let mesh = keep_components(mesh, config.min_component_share);
    if mesh.triangles.is_empty() {
        return Err(MeshError::Empty);
    }
    on_stage("simplifying");
    Ok(match config.simplify {
        Some(share) => simplify(&mesh, share),
        None => mesh,
    })
}

#[cfg(test)]
mod tests;
