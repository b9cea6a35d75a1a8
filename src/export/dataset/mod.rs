//! A run's images with their poses, as other trainers take them: COLMAP's model, and `transforms.json`.
//!
//! Images are those of an ideal pinhole, in `images/`. Masks, where an image is not whole, are in `masks/`, as COLMAP names them. Points are places
//! on surfaces without observations. Left out: depth in COLMAP's models, which have no place for it.

mod colmap;
mod transforms;

use std::path::Path;

use clap::builder::PossibleValue;

use super::ExportError;
use crate::files::write_atomically;
use crate::geometry::{Pinhole, Se3};
use crate::splat::GaussianCloud;
use crate::splat::sh::SH_C0;

/// Folder of the images.
pub const IMAGES: &str = "images";
/// Folder of the masks: black pixels are to be ignored.
pub const MASKS: &str = "masks";
/// Folder of the depth images: 16-bit millimetres along z, 0 where nothing was measured.
pub const DEPTH: &str = "depth";

/// A layout of images with known poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DatasetFormat {
    /// COLMAP's binary model in `sparse/0`.
    Colmap,
    /// COLMAP's text model in `sparse/0`.
    ColmapText,
    /// `transforms.json`, as nerfstudio has it, with `points.ply`.
    Transforms,
}

/// An image with its pose.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedImage {
    /// File name in [`IMAGES`].
    pub name: String,
    /// Its camera, without distortion; principal point from the first pixel's centre.
    pub pinhole: Pinhole,
    /// Pose of the camera; x right, y down, z forward.
    pub world_from_camera: Se3,
    /// Whether [`MASKS`] has a mask of it, named by [`mask_name`].
    pub has_mask: bool,
    /// Whether [`DEPTH`] has its depth, named by [`depth_name`].
    pub has_depth: bool,
}

/// A place on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// In the world of the poses.
    pub position: [f32; 3],
    /// sRGB.
    pub color: [u8; 3],
}

/// File name of an image's mask.
pub fn mask_name(image: &str) -> String {
    format!("{image}.png")
}

/// File name of an image's depth.
pub fn depth_name(image: &str) -> String {
    let stem = image.rsplit_once('.').map_or(image, |(stem, _)| stem);
    format!("{stem}.png")
}

/// The centres of a map's Gaussians, with the colour that the first harmonic gives them.
pub fn surface_points(cloud: &GaussianCloud) -> Vec<SurfacePoint> {
    let coefficients = cloud.sh_degree.coefficients();
    let point = |(i, mean): (usize, &glam::Vec3)| {
        let color = (cloud.sh[i * coefficients] * SH_C0 + 0.5).clamp(glam::Vec3::ZERO, glam::Vec3::ONE) * 255.0;
        SurfacePoint { position: mean.to_array(), color: color.to_array().map(|channel| channel.round() as u8) }
    };
    cloud.means.iter().enumerate().map(point).collect()
}

impl DatasetFormat {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Colmap, Self::ColmapText, Self::Transforms];

    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Colmap => "colmap",
            Self::ColmapText => "colmap-text",
            Self::Transforms => "transforms",
        }
    }

    /// Name and description for `--help`.
    pub fn possible_value(self) -> PossibleValue {
        PossibleValue::new(self.name()).help(match self {
            Self::Colmap => "Folder of images with COLMAP's binary model: poses and points for other trainers.",
            Self::ColmapText => "The same with COLMAP's text model.",
            Self::Transforms => "Folder of images with transforms.json, masks and depth, as nerfstudio has it.",
        })
    }

    /// Whether it has a place for depth images.
    pub fn has_depth(self) -> bool {
        self == Self::Transforms
    }

    /// Writes poses and points into the folder, whose images are there. The same bytes for the same ones.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(self, folder: &Path, images: &[PosedImage], points: &[SurfacePoint]) -> Result<(), ExportError> {
        let files = match self {
            Self::Colmap => colmap::binary(images, points),
            Self::ColmapText => colmap::text(images, points),
            Self::Transforms => transforms::files(images, points),
        };
        for (name, bytes) in files {
            let path = folder.join(name);
            let parent = path.parent().unwrap_or(folder);
            std::fs::create_dir_all(parent).map_err(|source| crate::files::WriteError { path: parent.into(), source })?;
            write_atomically(&path, &bytes)?;
        }
        Ok(())
    }
}

/// The images' different cameras, and which one each image has.
fn cameras(images: &[PosedImage]) -> (Vec<Pinhole>, Vec<usize>) {
    let mut cameras: Vec<Pinhole> = Vec::new();
    let camera_of = |image: &PosedImage| {
        cameras.iter().position(|camera| *camera == image.pinhole).unwrap_or_else(|| {
            cameras.push(image.pinhole);
            cameras.len() - 1
        })
    };
    let of_image = images.iter().map(camera_of).collect();
    (cameras, of_image)
}
