//! Map formats, one file of code each.
//!
//! Adding a format takes one file and one row in [`MapFormat`]. Trajectories are written by [`crate::geometry::Trajectory`].

pub mod ply;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::files::{WriteError, write_atomically};
use crate::splat::GaussianCloud;

/// The formats a map can be exported to and read from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum MapFormat {
    /// The PLY of the 3D Gaussian Splatting reference code, binary little endian: what every viewer reads.
    #[default]
    Ply,
}

impl MapFormat {
    pub const ALL: [Self; 1] = [Self::Ply];

    /// Extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
        }
    }

    /// The format a file's extension stands for.
    pub fn of_path(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?;
        Self::ALL.into_iter().find(|format| format.extension().eq_ignore_ascii_case(extension))
    }

    /// The file's bytes, the same ones for the same map.
    pub fn encode(self, cloud: &GaussianCloud) -> Result<Vec<u8>, ExportError> {
        match self {
            Self::Ply => ply::encode(cloud),
        }
    }

    /// Encodes and writes a map; returns the bytes that were written, for their hash.
    pub fn write(self, cloud: &GaussianCloud, path: &Path) -> Result<Vec<u8>, ExportError> {
        let bytes = self.encode(cloud)?;
        write_atomically(path, &bytes)?;
        Ok(bytes)
    }

    pub fn read(self, path: &Path) -> Result<GaussianCloud, ExportError> {
        match self {
            Self::Ply => ply::read(path),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("Gaussian {index} of the map is not finite, so the map was not exported; please report this with the run's log")]
    NonFinite { index: usize },
    #[error("{path}:{line}: {what}; expected the header of a binary little-endian 3DGS PLY")]
    Header { path: PathBuf, line: usize, what: String },
    #[error(
        "{path}: the header promises {vertices} Gaussians of {stride} bytes, but {found} bytes follow it; the file is cut off or damaged: copy or export it anew"
    )]
    Length { path: PathBuf, vertices: u64, stride: usize, found: u64 },
    #[error("{path}: `{property}` of Gaussian {index} is {value}; the map is damaged: export it anew")]
    Value { path: PathBuf, index: usize, property: String, value: f32 },
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::{Gaussian, ShDegree};
    use glam::{Quat, Vec3};

    /// A small cloud without two equal numbers in it.
    pub(super) fn cloud(sh_degree: ShDegree, len: usize) -> GaussianCloud {
        let mut rng = fastrand::Rng::with_seed(7);
        let mut cloud = GaussianCloud::new(sh_degree);
        for _ in 0..len {
            let mut vector = || Vec3::new(rng.f32(), rng.f32(), rng.f32()) - 0.5;
            let gaussian = Gaussian {
                mean: vector() * 8.0,
                log_scale: vector() - 3.0,
                rotation: Quat::from_scaled_axis(vector()),
                raw_opacity: vector().x * 4.0,
                sh: (0..sh_degree.coefficients()).map(|_| vector()).collect(),
            };
            cloud.push(gaussian);
        }
        cloud
    }

    #[test]
    fn every_format_gives_back_what_it_took() {
        let folder = tempfile::tempdir().unwrap();
        for format in MapFormat::ALL {
            for sh_degree in ShDegree::ALL {
                let cloud = cloud(sh_degree, 20);
                let path = folder.path().join("map").with_extension(format.extension());
                let bytes = format.write(&cloud, &path).unwrap();
                assert_eq!(MapFormat::of_path(&path), Some(format));
                let back = format.read(&path).unwrap();
                assert_eq!(back.sh_degree, cloud.sh_degree);
                let close = |a: Vec3, b: Vec3| a.distance(b) < 1e-6;
                assert!(back.means.iter().zip(&cloud.means).all(|(&a, &b)| close(a, b)));
                assert!(back.log_scales.iter().zip(&cloud.log_scales).all(|(&a, &b)| close(a, b)));
                assert!(back.sh.len() == cloud.sh.len() && back.sh.iter().zip(&cloud.sh).all(|(&a, &b)| close(a, b)));
                assert!(back.raw_opacities.iter().zip(&cloud.raw_opacities).all(|(a, b)| (a - b).abs() < 1e-6));
                assert!(back.rotations.iter().zip(&cloud.rotations).all(|(a, b)| a.dot(*b).abs() > 1.0 - 1e-6));
                assert_eq!(format.encode(&back).unwrap(), bytes, "exporting again changes nothing");
            }
        }
    }
}
