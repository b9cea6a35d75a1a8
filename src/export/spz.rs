//! SPZ (Niantic, MIT), versions 2 and 3: one gzip stream of a header and the attributes, one after the other, in 8 to 24 bits each. Version 4
//! has the same attributes in a container of its own, see [`spz4`].
//!
//! Writes version 3, which most readers know. Left out: harmonics above degree 3.

use std::io::{BufRead, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::bufread::MultiGzDecoder;
use flate2::write::GzEncoder;
use glam::{Quat, Vec3};

use super::axes::turned;
use super::harmonics::fit_harmonics;
use super::{ExportError, FileSize, FormatRow, spz4};
use crate::geometry::Se3;
use crate::splat::{Gaussian, GaussianCloud, ShDegree, opacity_from_raw, raw_opacity_of_byte, unit_rotation};

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "spz",
    extension: "spz",
    help: "SPZ version 3: about a fifth of the PLY's size, quantised; most web viewers read it.",
    keeps_antialiasing: true,
    is_lossless: false,
    tolerance: 0.06,
    encode: Some(encode),
    decode,
};

pub(super) const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// Flag of maps whose opacities are compensated for the pixel's dilation.
pub(super) const ANTIALIASED: u8 = 1;
const HEADER: usize = 16;
/// Positions are fixed-point numbers of 24 bits, of which usually so many are behind the point.
const FRACTIONAL_BITS: i32 = 12;
/// More where Gaussians are small: a step is at most this share of the median of their least extents.
const STEP: f32 = 1.0 / 8.0;
pub(super) const POSITION_BITS: i32 = 24;
/// A colour's byte per unit of the constant harmonic.
const COLOR_SCALE: f32 = 0.15;
/// Harmonics beyond the constant one are signed bytes, in steps of 1/128.
const MOST_HARMONIC: f32 = 127.0 / 128.0;
/// Bytes are `(log scale + 10) · 16`.
const LOG_SCALE: (f32, f32) = (10.0, 16.0);
/// Most Gaussians that readers of SPZ accept.
pub(super) const MOST_GAUSSIANS: u64 = 10_000_000;
/// A compressed byte stands for no more than this.
const MOST_INFLATION: u64 = 1032;

/// Bytes of a Gaussian in a version.
fn stride(version: u32, degree: ShDegree) -> usize {
    let rotation = if version >= 3 { 4 } else { 3 };
    9 + 1 + 3 + 3 + rotation + 3 * (degree.coefficients() - 1)
}

/// Attributes of Gaussians as the versions from 3 on have them.
pub(super) struct Packed {
    pub count: u32,
    pub degree: ShDegree,
    /// Bits of a position behind the point, of 24.
    pub bits: i32,
    /// [`ANTIALIASED`] or none.
    pub flags: u8,
    /// Positions, opacities, colours, scales, rotations and harmonics.
    pub attributes: [Vec<u8>; 6],
}

impl Packed {
    /// Larger harmonics are fitted to the colours that the cameras see.
    pub fn new(cloud: &GaussianCloud, cameras: &[Se3]) -> Result<Self, ExportError> {
        if let Some(index) = cloud.first_non_finite() {
            return Err(ExportError::NonFinite { index });
        }
        if cloud.len() as u64 > MOST_GAUSSIANS {
            return Err(ExportError::Encode { reason: format!("SPZ holds {MOST_GAUSSIANS} Gaussians at most") });
        }
        let cloud = turned(&fit_harmonics(cloud, cameras, MOST_HARMONIC));
        let bits = fractional_bits(&cloud);
        let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
        let fixed = |coordinate: f32| {
            let most = (1 << (POSITION_BITS - 1)) - 1;
            let fixed = (f64::from(coordinate) * 2f64.powi(bits)).round() as i32;
            let [a, b, c, _] = fixed.clamp(-most, most).to_le_bytes();
            [a, b, c]
        };
        let harmonics = || cloud.sh.chunks(cloud.sh_degree.coefficients());
        let constants = harmonics().flat_map(|sh| sh[0].to_array());
        let rest = harmonics().flat_map(|sh| sh[1..].iter().flat_map(|c| c.to_array()));
        let scales = cloud.log_scales.iter().flat_map(|scale| scale.to_array());
        let attributes = [
            cloud.means.iter().flat_map(|mean| mean.to_array()).flat_map(fixed).collect(),
            cloud.raw_opacities.iter().map(|raw| byte(opacity_from_raw(*raw) * 255.0)).collect(),
            constants.map(|value| byte((value * COLOR_SCALE + 0.5) * 255.0)).collect(),
            scales.map(|scale| byte((scale + LOG_SCALE.0) * LOG_SCALE.1)).collect(),
            cloud.rotations.iter().flat_map(|rotation| smallest_three(*rotation).to_le_bytes()).collect(),
            rest.map(|value| byte(value * 128.0 + 128.0)).collect(),
        ];
        let flags = if cloud.antialiased { ANTIALIASED } else { 0 };
        Ok(Self { count: cloud.len() as u32, degree: cloud.sh_degree, bits, flags, attributes })
    }

    /// Bytes of each attribute of so many Gaussians.
    pub fn lengths(count: u64, degree: ShDegree) -> [u64; 6] {
        [9, 1, 3, 3, 4, 3 * (degree.coefficients() as u64 - 1)].map(|bytes| bytes * count)
    }
}

fn encode(cloud: &GaussianCloud, cameras: &[Se3]) -> Result<Vec<u8>, ExportError> {
    let packed = Packed::new(cloud, cameras)?;
    let mut bytes = [MAGIC, VERSION, packed.count].map(u32::to_le_bytes).concat();
    bytes.extend([packed.degree.get(), packed.bits as u8, packed.flags, 0]);
    packed.attributes.iter().for_each(|attribute| bytes.extend(attribute));
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(&bytes).and_then(|()| encoder.finish()).map_err(|error| ExportError::Encode { reason: error.to_string() })
}

/// Bits behind the point: enough for small Gaussians, and few enough for the farthest.
fn fractional_bits(cloud: &GaussianCloud) -> i32 {
    let farthest = cloud.means.iter().map(|mean| mean.abs().max_element()).fold(1e-3, f32::max);
    let most = POSITION_BITS - 1 - farthest.log2().floor() as i32 - 1;
    let mut least: Vec<f32> = cloud.log_scales.iter().map(|scale| scale.min_element()).collect();
    least.sort_unstable_by(f32::total_cmp);
    let median = least.get(least.len() / 2).map_or(0.0, |log_scale| log_scale.clamp(-20.0, 0.0).exp());
    let wanted = -(median.max(f32::MIN_POSITIVE) * STEP).log2().floor() as i32;
    wanted.max(FRACTIONAL_BITS).min(most).clamp(0, POSITION_BITS - 1)
}

/// Sign and nine bits for each component but the largest, which is made positive; its index in the top bits.
fn smallest_three(rotation: Quat) -> u32 {
    let q = unit_rotation(rotation).to_array();
    let largest = (0..4).fold(0, |largest, k| if q[k].abs() > q[largest].abs() { k } else { largest });
    let flips = q[largest] < 0.0;
    (0..4).filter(|k| *k != largest).fold(largest as u32, |bits, k| {
        let magnitude = (q[k].abs() * std::f32::consts::SQRT_2 * 511.0).round().min(511.0) as u32;
        bits << 10 | u32::from((q[k] < 0.0) != flips) << 9 | magnitude
    })
}

fn from_smallest_three(mut bits: u32) -> Quat {
    let largest = (bits >> 30) as usize;
    let mut q = [0f32; 4];
    for k in (0..4).rev().filter(|k| *k != largest) {
        let magnitude = (bits & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        q[k] = if bits >> 9 & 1 == 1 { -magnitude } else { magnitude };
        bits >>= 10;
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    Quat::from_array(q)
}

/// Version 2: three bytes, and a positive w.
fn from_first_three(bytes: &[u8]) -> Quat {
    let v = Vec3::new(f32::from(bytes[0]), f32::from(bytes[1]), f32::from(bytes[2])) / 127.5 - 1.0;
    let w = (1.0 - v.length_squared()).max(0.0).sqrt();
    Quat::from_xyzw(v.x, v.y, v.z, w).normalize()
}

/// All versions that are read.
pub(super) fn decode(reader: &mut dyn BufRead, size: FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let FileSize(file_bytes) = size;
    let damaged = |what: String| ExportError::Damaged { path: path.into(), what };
    let mut start = [0u8; 4];
    let peeked = reader.fill_buf().map_err(|source| ExportError::Read { path: path.into(), source })?;
    let known = peeked.len().min(4);
    start[..known].copy_from_slice(&peeked[..known]);
    if u32::from_le_bytes(start) == MAGIC {
        return spz4::decode(reader, size, path);
    }
    let mut stream = MultiGzDecoder::new(reader);
    let mut header = [0u8; HEADER];
    stream.read_exact(&mut header).map_err(|_| damaged("this is no SPZ file".into()))?;
    let word = |at: usize| u32::from_le_bytes(header[at..at + 4].try_into().expect("four bytes"));
    let (magic, version, count) = (word(0), word(4), word(8) as u64);
    let degree = ShDegree::new(header[12]).filter(|_| magic == MAGIC && (2..=3).contains(&version));
    let degree = degree.ok_or_else(|| damaged(format!("version {version} of degree {} is not read", header[12])))?;
    let bits = i32::from(header[13]);
    if bits >= POSITION_BITS {
        return Err(damaged(format!("{bits} of a position's 24 bits cannot be behind the point")));
    }
    let expected = count * stride(version, degree) as u64;
    let cut = || damaged(format!("{count} Gaussians are promised, but the file is cut off or longer"));
    if count > MOST_GAUSSIANS {
        return Err(damaged(format!("{count} Gaussians are promised; at most {MOST_GAUSSIANS} are read")));
    }
    if expected > file_bytes.saturating_mul(MOST_INFLATION) {
        return Err(cut());
    }
    let mut bytes = Vec::new();
    stream.take(expected + 1).read_to_end(&mut bytes).map_err(|_| cut())?;
    if bytes.len() as u64 != expected {
        return Err(cut());
    }
    let cloud = unpack(&bytes, count as usize, version, degree, bits);
    Ok(GaussianCloud { antialiased: header[14] & ANTIALIASED != 0, ..cloud })
}

/// The Gaussians of the attributes, which are as long as they should be, in the map's axes.
pub(super) fn unpack(bytes: &[u8], count: usize, version: u32, degree: ShDegree, bits: i32) -> GaussianCloud {
    let rotation_bytes = if version >= 3 { 4 } else { 3 };
    let harmonics = degree.coefficients() - 1;
    let (positions, rest) = bytes.split_at(9 * count);
    let (opacities, rest) = rest.split_at(count);
    let (colors, rest) = rest.split_at(3 * count);
    let (scales, rest) = rest.split_at(3 * count);
    let (rotations, sh) = rest.split_at(rotation_bytes * count);
    let mut cloud = GaussianCloud::new(degree);
    for i in 0..count {
        let triple = |bytes: &[u8], at: usize| Vec3::new(bytes[at].into(), bytes[at + 1].into(), bytes[at + 2].into());
        let coordinate = |c: usize| {
            let at = 9 * i + 3 * c;
            // The sign is that of the top byte.
            let fixed = i32::from_le_bytes([0, positions[at], positions[at + 1], positions[at + 2]]) >> 8;
            (f64::from(fixed) / 2f64.powi(bits)) as f32
        };
        let rotation = &rotations[rotation_bytes * i..rotation_bytes * (i + 1)];
        let constant = (triple(colors, 3 * i) / 255.0 - 0.5) / COLOR_SCALE;
        let beyond = (0..harmonics).map(|k| (triple(sh, 3 * (i * harmonics + k)) - 128.0) / 128.0);
        cloud.push(Gaussian {
            mean: Vec3::new(coordinate(0), coordinate(1), coordinate(2)),
            log_scale: triple(scales, 3 * i) / LOG_SCALE.1 - LOG_SCALE.0,
            rotation: match rotation {
                [a, b, c, d] => from_smallest_three(u32::from_le_bytes([*a, *b, *c, *d])),
                three => from_first_three(three),
            },
            raw_opacity: raw_opacity_of_byte(opacities[i]),
            sh: std::iter::once(constant).chain(beyond).collect(),
        });
    }
    turned(&cloud)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One Gaussian, coded by hand: in SPZ's axes at (1, −2, −3), turned by 60° about y.
    fn file(version: u32, rotation: &[u8]) -> Vec<u8> {
        let mut bytes = [MAGIC, version, 1].map(u32::to_le_bytes).concat();
        bytes.extend([1, 12, 0, 0]);
        bytes.extend([0x00, 0x10, 0x00, 0x00, 0xe0, 0xff, 0x00, 0xd0, 0xff]);
        bytes.extend([204, 255, 0, 128, 160, 144, 128]);
        bytes.extend(rotation);
        bytes.extend([128, 192, 255, 0, 64, 128, 128, 128, 128]);
        let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
        encoder.write_all(&bytes).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn a_file_of_others_is_read() {
        let word = (3u32 << 30 | 361 << 10).to_le_bytes();
        for (version, rotation) in [(3, &word[..]), (2, &[127, 191, 127])] {
            let bytes = file(version, rotation);
            let cloud = decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.spz")).unwrap();
            let only = cloud.get(0);
            assert_eq!((cloud.len(), only.mean), (1, Vec3::new(1.0, 2.0, 3.0)));
            assert!((only.raw_opacity - 4f32.ln()).abs() < 1e-5);
            assert!(only.sh[0].distance(Vec3::new(0.5 / 0.15, -0.5 / 0.15, (128.0 / 255.0 - 0.5) / 0.15)) < 1e-5);
            assert_eq!(only.log_scale, Vec3::new(0.0, -1.0, -2.0));
            let (sin, cos) = 30f32.to_radians().sin_cos();
            assert!(only.rotation.dot(Quat::from_xyzw(0.0, -sin, 0.0, cos)).abs() > 1.0 - 1e-4, "{}", only.rotation);
            // The harmonics of y and z change their signs with the axes.
            assert_eq!(only.sh[1], -Vec3::new(0.0, 0.5, 127.0 / 128.0));
            assert_eq!(only.sh[2], -Vec3::new(-1.0, -0.5, 0.0));
        }
        let bytes = file(5, &word);
        assert!(decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.spz")).is_err());
    }
}
