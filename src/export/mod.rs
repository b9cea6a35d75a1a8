//! Map formats, one file of code each.
//!
//! Adding a format takes one file and one row in `FORMATS`, before those that are only read. Trajectories are written by [`crate::geometry::Trajectory`].

mod axes;
pub mod dataset;
mod filter;
mod glb;
mod harmonics;
pub mod lod;
mod ply;
mod sog;
mod splat;
mod spz;
mod spz4;

pub use filter::ExportFilter;

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use clap::builder::PossibleValue;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use crate::files::{WriteError, write_atomically};
use crate::geometry::Se3;
use crate::splat::GaussianCloud;

/// All formats; the first one is the default, and the last ones are only read.
static FORMATS: [MapFormat; 7] = [
    MapFormat(&ply::FORMAT),
    MapFormat(&spz::FORMAT),
    MapFormat(&sog::FORMAT),
    MapFormat(&glb::FORMAT),
    MapFormat(&spz4::FORMAT),
    MapFormat(&sog::COMPACT_FORMAT),
    MapFormat(&splat::FORMAT),
];
/// Number of formats that are written: the first ones of [`FORMATS`].
const WRITTEN: usize = 6;

/// Encodes a map for cameras at these poses, world from camera, which may be none.
type Encoder = fn(&GaussianCloud, &[Se3]) -> Result<Vec<u8>, ExportError>;

/// A map format: encoder and decoder.
struct FormatRow {
    /// Name on the command line and in configurations.
    name: &'static str,
    /// Extension of its files, without the dot.
    extension: &'static str,
    /// One sentence for `--help`.
    help: &'static str,
    /// Whether files say that a map is antialiased.
    keeps_antialiasing: bool,
    /// Whether a map that is written and read again is written as the same bytes.
    is_lossless: bool,
    /// Largest error of a value but positions, whose error is a fiftieth of it.
    tolerance: f32,
    /// The file's bytes, the same ones for the same map and cameras; none where the format is only read.
    encode: Option<Encoder>,
    /// Reads a file; the path is named in errors.
    decode: fn(&mut dyn BufRead, FileSize, &Path) -> Result<GaussianCloud, ExportError>,
}

/// Size of a file, bytes: headers that promise more are refused before memory is reserved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileSize(pub u64);

/// A file format of Gaussian maps.
#[derive(Clone, Copy)]
pub struct MapFormat(&'static FormatRow);

impl MapFormat {
    /// All formats; the first one is the default.
    pub fn all() -> &'static [Self] {
        &FORMATS
    }

    /// The format of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        FORMATS.iter().copied().find(|format| format.name() == name)
    }

    /// The format of a file's extension, in any case; of several, the first. All of an extension are read alike.
    pub fn of_path(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?;
        FORMATS.iter().copied().find(|format| format.extension().eq_ignore_ascii_case(extension))
    }

    /// Name on the command line and in configurations.
    pub fn name(self) -> &'static str {
        self.0.name
    }

    /// Whether files say that a map is antialiased, and readers keep it.
    pub fn keeps_antialiasing(self) -> bool {
        self.0.keeps_antialiasing
    }

    /// Whether a map that is written and read again is written as the same bytes.
    pub fn is_lossless(self) -> bool {
        self.0.is_lossless
    }

    /// Largest error of a value but positions, whose error is a fiftieth of it.
    pub fn tolerance(self) -> f32 {
        self.0.tolerance
    }

    /// Whether maps are written in it, and not only read.
    pub fn is_written(self) -> bool {
        self.0.encode.is_some()
    }

    /// Extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        self.0.extension
    }

    /// Encodes a map; the same bytes for the same map.
    ///
    /// # Errors
    /// As [`Self::encode_for`].
    pub fn encode(self, cloud: &GaussianCloud) -> Result<Vec<u8>, ExportError> {
        self.encode_for(cloud, &[])
    }

    /// Encodes a map such that cameras at these poses, world from camera, see the least change.
    ///
    /// # Errors
    /// If a value of the map is not finite, or the format is only read.
    pub fn encode_for(self, cloud: &GaussianCloud, cameras: &[Se3]) -> Result<Vec<u8>, ExportError> {
        let encode = self.0.encode.ok_or_else(|| {
            let names: Vec<String> = FORMATS[..WRITTEN].iter().map(|format| format.name().into()).collect();
            ExportError::ReadOnly { format: self.name(), written: names.join(", ") }
        })?;
        encode(cloud, cameras)
    }

    /// Encodes and writes a map; returns the bytes that were written, for their hash.
    ///
    /// # Errors
    /// As [`Self::write_for`].
    pub fn write(self, cloud: &GaussianCloud, path: &Path) -> Result<Vec<u8>, ExportError> {
        self.write_for(cloud, &[], path)
    }

    /// Encodes and writes a map, as [`Self::encode_for`]; returns the bytes that were written.
    ///
    /// # Errors
    /// If a value of the map is not finite, the format is only read, or the file cannot be written.
    pub fn write_for(self, cloud: &GaussianCloud, cameras: &[Se3], path: &Path) -> Result<Vec<u8>, ExportError> {
        let bytes = self.encode_for(cloud, cameras)?;
        write_atomically(path, &bytes)?;
        Ok(bytes)
    }

    /// Reads a map.
    ///
    /// # Errors
    /// If the file cannot be read, is cut off, or holds a value that is not finite.
    pub fn read(self, path: &Path) -> Result<GaussianCloud, ExportError> {
        let read_error = |source| ExportError::Read { path: path.into(), source };
        let file = File::open(path).map_err(read_error)?;
        let size = FileSize(file.metadata().map_err(read_error)?.len());
        (self.0.decode)(&mut BufReader::new(file), size, path)
    }

    /// Decodes a map from bytes, for the fuzz target.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn decode(self, mut bytes: &[u8]) -> Result<GaussianCloud, ExportError> {
        let size = FileSize(bytes.len() as u64);
        (self.0.decode)(&mut bytes, size, Path::new("file"))
    }
}

impl Default for MapFormat {
    fn default() -> Self {
        FORMATS[0]
    }
}

impl PartialEq for MapFormat {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for MapFormat {}

impl std::fmt::Debug for MapFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl clap::ValueEnum for MapFormat {
    fn value_variants<'a>() -> &'a [Self] {
        &FORMATS[..WRITTEN]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.0.name).help(self.0.help))
    }
}

impl Serialize for MapFormat {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for MapFormat {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        let known = || FORMATS[..WRITTEN].iter().map(|format| format.name()).collect::<Vec<_>>().join(", ");
        let format = Self::by_name(&name).filter(|format| format.is_written());
        format.ok_or_else(|| de::Error::custom(format!("no map is written as `{name}`; choose one of {}", known())))
    }
}

/// A map that cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A Gaussian has a value that is not finite.
    #[error("Gaussian {index} of the map is not finite, so the map was not exported; please report this with the run's log")]
    NonFinite {
        /// Index in the map.
        index: usize,
    },
    /// The format is only read.
    #[error("maps are read from {format} and not written to it; choose one of {written}")]
    ReadOnly {
        /// The format's name.
        format: &'static str,
        /// Names of those that are written.
        written: String,
    },
    /// The map cannot be encoded.
    #[error("the map cannot be encoded: {reason}")]
    Encode {
        /// The cause.
        reason: String,
    },
    /// The file is not of the format, or damaged.
    #[error("{path}: {what}; copy or export it anew")]
    Damaged {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The file's header is not that of the format.
    #[error("{path}:{line}: {what}; expected the header of a binary little-endian 3DGS PLY")]
    Header {
        /// The file or folder.
        path: PathBuf,
        /// Line in the file, from 1.
        line: usize,
        /// What is wrong.
        what: String,
    },
    /// The file is shorter or longer than its header states.
    #[error(
        "{path}: the header promises {vertices} Gaussians of {stride} bytes, but {found} bytes follow it; the file is cut off or damaged: copy or export it anew"
    )]
    Length {
        /// The file or folder.
        path: PathBuf,
        /// Gaussians in the header.
        vertices: u64,
        /// Bytes of a Gaussian.
        stride: usize,
        /// Bytes after the header.
        found: u64,
    },
    /// A value in the file is not finite.
    #[error("{path}: `{property}` of Gaussian {index} is {value}; the map is damaged: export it anew")]
    Value {
        /// The file or folder.
        path: PathBuf,
        /// Index in the map.
        index: usize,
        /// Name of the property.
        property: String,
        /// The value found.
        value: f32,
    },
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
    fn formats_are_known_by_name_and_extension() {
        let names = |formats: &[MapFormat]| formats.iter().map(|format| format.name()).collect::<Vec<_>>();
        assert_eq!(names(MapFormat::all()), names(&FORMATS));
        assert_eq!(names(<MapFormat as clap::ValueEnum>::value_variants()), names(&FORMATS[..WRITTEN]));
        assert_eq!((MapFormat::default().name(), MapFormat::default().extension()), ("ply", "ply"));
        assert_eq!(MapFormat::by_name("xyz"), None);
        for unknown in ["map", "map.xyz", "ply"] {
            assert_eq!(MapFormat::of_path(Path::new(unknown)), None, "{unknown}");
        }
        assert_eq!(MapFormat::of_path(Path::new("a/MAP.PLY")), Some(MapFormat::default()));
        for format in MapFormat::all() {
            assert_eq!(format!("{format:?}"), format.name());
            assert_eq!(MapFormat::by_name(format.name()), Some(*format));
        }
        assert!(FORMATS.iter().enumerate().all(|(place, format)| format.is_written() == (place < WRITTEN)));
        for format in &FORMATS[..WRITTEN] {
            assert_eq!(<MapFormat as clap::ValueEnum>::from_str(format.name(), false), Ok(*format));
            assert_eq!(serde_json::from_str::<MapFormat>(&format!("\"{}\"", format.name())).unwrap(), *format);
        }
        let unknown = serde_json::from_str::<MapFormat>("\"xyz\"").unwrap_err().to_string();
        assert!(unknown.contains("xyz") && unknown.contains("ply"), "{unknown}");
        for format in &FORMATS[WRITTEN..] {
            assert!(serde_json::from_str::<MapFormat>(&format!("\"{}\"", format.name())).is_err());
            let refused = format.encode(&cloud(ShDegree::default(), 1)).unwrap_err().to_string();
            assert!(refused.contains(format.name()) && refused.contains("ply, spz, sog"), "{refused}");
        }
    }

    #[test]
    fn formats_of_other_names_are_not_equal() {
        static OTHER: FormatRow = FormatRow { name: "other", ..ply::FORMAT };
        assert_ne!(MapFormat(&OTHER), MapFormat::default());
        assert_eq!(MapFormat(&OTHER), MapFormat(&OTHER));
    }

    #[test]
    fn every_format_gives_back_what_it_took() {
        let folder = tempfile::tempdir().unwrap();
        for &format in &FORMATS[..WRITTEN] {
            for sh_degree in ShDegree::ALL {
                let cloud = cloud(sh_degree, 20);
                let path = folder.path().join("map").with_extension(format.extension());
                let bytes = format.write(&cloud, &path).unwrap();
                assert_eq!(MapFormat::of_path(&path).map(MapFormat::extension), Some(format.extension()));
                let back = format.read(&path).unwrap();
                assert_eq!(back.sh_degree, cloud.sh_degree);
                let (rough, fine) = (format.tolerance(), format.tolerance() / 50.0);
                let close = |a: Vec3, b: Vec3| a.distance(b) < rough;
                // Of a format that sorts its Gaussians, too.
                let nearest =
                    |mean: Vec3| (0..20).min_by(|a, b| mean.distance(cloud.means[*a]).total_cmp(&mean.distance(cloud.means[*b])));
                let mut cloud_in_its_order = GaussianCloud::new(sh_degree);
                back.means.iter().for_each(|mean| cloud_in_its_order.push(cloud.get(nearest(*mean).unwrap())));
                let cloud = cloud_in_its_order;
                assert!(back.means.iter().zip(&cloud.means).all(|(a, b)| a.distance(*b) < fine));
                assert!(back.log_scales.iter().zip(&cloud.log_scales).all(|(&a, &b)| close(a, b)));
                assert!(back.sh.len() == cloud.sh.len() && back.sh.iter().zip(&cloud.sh).all(|(&a, &b)| close(a, b)));
                assert!(back.raw_opacities.iter().zip(&cloud.raw_opacities).all(|(a, b)| (a - b).abs() < rough));
                assert!(
                    back.rotations
                        .iter()
                        .zip(&cloud.rotations)
                        .all(|(a, b)| a.dot(*b).abs() > 1.0 - (0.01 * rough * rough).max(1e-6))
                );
                assert!(!format.is_lossless() || format.encode(&back).unwrap() == bytes, "exporting again changes nothing");
                assert_eq!(format.decode(&bytes).unwrap(), back);
                assert!((0..bytes.len()).step_by(7).all(|cut| format.decode(&bytes[..cut]).is_err()), "a file that is cut off");
            }
        }
    }
}
