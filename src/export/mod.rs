//! Maps to files, one file of code per format, and the one way in which this project writes any file.
//!
//! Adding a format takes one file and one row in [`MapFormat`]. Trajectories are written by [`crate::geometry::Trajectory`].

pub mod ply;

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

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
    #[error("cannot write {path}: {source}; {advice}", advice = advice(source.kind()))]
    Write { path: PathBuf, source: std::io::Error },
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

fn advice(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "free some space or write to another disk",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "choose a folder that you may write to",
        ErrorKind::NotFound | ErrorKind::NotADirectory => "create the folder first",
        ErrorKind::IsADirectory => "a folder has that name: remove it or choose another name",
        _ => "check the disk and the path",
    }
}

/// Writes a file so that it is never seen half-written: under another name in the same folder first, then renamed. Replaces what
/// was there. Not flushed to the disk itself: a power cut may still lose it.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), ExportError> {
    write(path, bytes, |_| Ok(()))
}

/// The same, flushed to the disk itself: after a power cut either the new file or the old one is there.
pub fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), ExportError> {
    write(path, bytes, std::fs::File::sync_all)?;
    // The rename is the folder's to keep; not every system opens folders as files.
    let folder = path.parent().and_then(|folder| std::fs::File::open(folder).ok());
    let _ = folder.map(|folder| folder.sync_all());
    Ok(())
}

/// Removes what writes that were killed left in a folder, as far as that is possible.
pub fn remove_partials(folder: &Path) {
    let is_partial = |name: &str| name.starts_with('.') && name.ends_with(PARTIAL);
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    for entry in entries.filter(|entry| entry.file_name().to_str().is_some_and(is_partial)) {
        let _ = std::fs::remove_file(entry.path());
    }
}

const PARTIAL: &str = ".partial";

fn write(path: &Path, bytes: &[u8], flush: impl Fn(&std::fs::File) -> std::io::Result<()>) -> Result<(), ExportError> {
    let write_error = |source| ExportError::Write { path: path.into(), source };
    let Some(name) = path.file_name() else {
        return Err(write_error(ErrorKind::IsADirectory.into()));
    };
    let mut partial_name = std::ffi::OsString::from(".");
    partial_name.push(name);
    partial_name.push(format!(".{}{PARTIAL}", std::process::id()));
    let partial = path.with_file_name(partial_name);
    let written = std::fs::File::create(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| flush(&file)))
        .and_then(|()| std::fs::rename(&partial, path));
    written.map_err(|source| {
        // Best effort: what failed is more worth telling than what is left over.
        let _ = std::fs::remove_file(&partial);
        write_error(source)
    })
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

    #[test]
    fn a_write_leaves_the_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        write_atomically(&path, b"one").unwrap();
        write_atomically(&path, b"two").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        write_durably(&path, b"three").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"three");
        std::fs::write(folder.path().join(".file.123.partial"), b"th").unwrap();
        remove_partials(folder.path());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn failed_writes_say_what_to_do_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let missing = write_atomically(&folder.path().join("no/file"), b"").unwrap_err().to_string();
        assert!(missing.contains("no/file") && missing.ends_with("create the folder first"), "{missing}");
        let taken = folder.path().join("taken");
        std::fs::create_dir(&taken).unwrap();
        assert!(write_atomically(&taken, b"").is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
