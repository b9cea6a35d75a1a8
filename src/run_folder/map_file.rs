//! The map in a run's folder: one file, of one format.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::outputs::{OutputError, remove_file};
use crate::evaluation::sha256_hex;
use crate::export::{ExportError, MapFormat};
use crate::files::write_durably;
use crate::geometry::Se3;
use crate::splat::GaussianCloud;

/// File name of a map.
pub fn map_name(format: MapFormat) -> String {
    format!("map.{}", format.extension())
}

/// The map in a run's folder, or the file itself, and its format, if there is one.
pub fn find_map(folder: &Path) -> Option<(PathBuf, MapFormat)> {
    if !folder.is_dir() {
        return MapFormat::of_path(folder).map(|format| (folder.into(), format));
    }
    let in_folder = |format: &MapFormat| (folder.join(map_name(*format)), *format);
    MapFormat::all().iter().map(in_folder).find(|(path, _)| path.is_file())
}

/// Size and hash of a map file.
#[derive(Clone, Debug)]
pub struct WrittenMap {
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256, hexadecimal.
    pub hash: String,
    /// The map as the file holds it.
    pub cloud: Arc<GaussianCloud>,
}

/// Writes a run's map such that cameras at these poses, world from camera, see the least change. An earlier map stays until the new one is on the disk.
///
/// # Errors
/// If a file cannot be written or removed, or the map holds a value that is not finite.
pub fn write_map(
    folder: &Path,
    format: MapFormat,
    cloud: &Arc<GaussianCloud>,
    cameras: &[Se3],
) -> Result<WrittenMap, OutputError> {
    let (bytes, format) = or_lossless(format.encode_for(cloud, cameras), format, cloud)?;
    let name = map_name(format);
    write_durably(&folder.join(&name), &bytes)?;
    for other in MapFormat::all().iter().map(|format| map_name(*format)).filter(|other| *other != name) {
        remove_file(&folder.join(other))?;
    }
    let cloud = if format.is_lossless() { cloud.clone() } else { Arc::new(format.decode(&bytes)?) };
    Ok(WrittenMap { bytes: bytes.len() as u64, hash: sha256_hex(&bytes), cloud })
}

/// An encoded map with its format: PLY where the format cannot hold the map, so that no run is lost to a format's bounds.
fn or_lossless(
    encoded: Result<Vec<u8>, ExportError>,
    format: MapFormat,
    cloud: &GaussianCloud,
) -> Result<(Vec<u8>, MapFormat), ExportError> {
    match encoded {
        Err(error @ ExportError::Encode { .. }) => {
            let lossless = MapFormat::default();
            tracing::warn!("{error}; it is written to {} instead", map_name(lossless));
            Ok((lossless.encode(cloud)?, lossless))
        }
        encoded => Ok((encoded?, format)),
    }
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};

    use super::*;
    use crate::splat::Gaussian;

    #[test]
    fn the_map_is_found_by_its_format() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(find_map(folder.path()), None);
        for &format in MapFormat::all() {
            let path = folder.path().join(format!("map.{}", format.extension()));
            std::fs::write(&path, b"").unwrap();
            // Formats of one extension are read alike.
            let first = MapFormat::of_path(&path).unwrap();
            assert_eq!(first.extension(), format.extension());
            assert_eq!(find_map(folder.path()), Some((path.clone(), first)));
            std::fs::remove_file(path).unwrap();
        }
    }

    #[test]
    fn no_map_is_lost_to_a_format_or_to_a_map_that_cannot_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let spz = MapFormat::by_name("spz").unwrap();
        let cloud = Arc::new(GaussianCloud::default());
        write_map(folder.path(), MapFormat::default(), &cloud, &[]).unwrap();
        let broken =
            Gaussian { mean: Vec3::NAN, log_scale: Vec3::ZERO, rotation: Quat::IDENTITY, raw_opacity: 0.0, sh: vec![Vec3::ZERO] };
        let mut unwritable = GaussianCloud::default();
        unwritable.push(broken);
        assert!(write_map(folder.path(), spz, &Arc::new(unwritable), &[]).is_err());
        assert_eq!(find_map(folder.path()).unwrap().1, MapFormat::default());
        write_map(folder.path(), spz, &cloud, &[]).unwrap();
        assert_eq!(find_map(folder.path()).unwrap().1, spz);
        let too_many = Err(ExportError::Encode { reason: "SPZ holds fewer".into() });
        let (bytes, format) = or_lossless(too_many, spz, &cloud).unwrap();
        assert_eq!((format.decode(&bytes).unwrap(), format), ((*cloud).clone(), MapFormat::default()));
    }
}
