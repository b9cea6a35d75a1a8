//! SOG version 2 (PlayCanvas' open format; read and written by splat-transform 2.7.1, MIT): a zip of lossless WebP images, one pixel a
//! Gaussian, and `meta.json`.
//!
//! Positions have 16 bits after a logarithm, rotations eight a component, sizes and colours the places in a codebook. Harmonics beyond the
//! constant one have labels into a palette. Streamed maps have the same images in folders; those are only written. Left out: version 1.

mod bundle;
mod codebook;
mod kmeans;
mod morton;
mod palette;
mod read;
mod write;

use serde::{Deserialize, Serialize};

pub(super) use morton::order;

use super::{ExportError, FormatRow};
use crate::geometry::Se3;
use crate::splat::GaussianCloud;

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "sog",
    extension: "sog",
    help: "SOG version 2: a seventh of the PLY's size, with a palette of harmonics; PlayCanvas and most web viewers read it.",
    keeps_antialiasing: true,
    is_lossless: false,
    // Positions are as exact as the Gaussians are large.
    tolerance: 0.2,
    encode: Some(|cloud, cameras| write::encode(cloud, cameras, &FINE)),
    decode: read::decode,
};

/// The row of smaller files.
pub(super) const COMPACT_FORMAT: FormatRow = FormatRow {
    name: "sog-compact",
    help: "SOG in a tenth of the PLY's size: coarser steps and fewer harmonics.",
    encode: Some(|cloud, cameras| write::encode(cloud, cameras, &COMPACT)),
    ..FORMAT
};

/// A file of a map in a folder instead of a zip.
pub(super) struct SogFile {
    pub name: &'static str,
    pub bytes: Vec<u8>,
}

/// The images of a map and, last, their description, for cameras at these poses, world from camera. Gaussians keep their order.
pub(super) fn files(cloud: GaussianCloud, cameras: &[Se3]) -> Result<Vec<SogFile>, ExportError> {
    write::encode_files(cloud, cameras, &FINE)
}

/// How closely a file holds a map. Values that are stored alike compress well.
struct Precision {
    /// Steps of the logarithms of sizes, of constant harmonics and of others.
    scale_step: f32,
    constant_step: f32,
    harmonic_step: f32,
    /// Positions are rounded to this share of the median of the Gaussians' least extents, or finer.
    position_step: f64,
    /// Steps of the bytes of rotations: two are 0.6 degrees.
    rotation_step: u8,
    /// Gaussians that share an entry of the palette, on average: an entry costs about as many bytes as five labels.
    gaussians_per_entry: f64,
    /// Weight of harmonics themselves beside the colours in a view, once entries are chosen: they are smaller then where nobody looks.
    ridge: f64,
}

/// Not visibly different from the map.
const FINE: Precision = Precision {
    scale_step: 1.0 / 24.0,
    constant_step: 0.0125,
    harmonic_step: 1.0 / 64.0,
    position_step: 1.0 / 32.0,
    rotation_step: 1,
    gaussians_per_entry: 2.5,
    ridge: 1e-5,
};

/// A twentieth of a size or less, half a percent of white, and less than a palette changes.
const COMPACT: Precision = Precision {
    scale_step: 1.0 / 12.0,
    constant_step: 0.025,
    harmonic_step: 1.0 / 16.0,
    position_step: 1.0 / 12.0,
    rotation_step: 2,
    gaussians_per_entry: 6.0,
    ridge: 1e-5,
};

const VERSION: u32 = 2;
pub(super) const META: &str = "meta.json";
/// Entries of the palette side by side in its image.
const ENTRIES_A_ROW: usize = 64;
/// The byte of a rotation whose largest component is w; x, y and z follow.
const LARGEST: u8 = 252;
/// Largest code of a position's 16 bits.
const MOST_CODE: f64 = 65535.0;

/// `meta.json`.
#[derive(Debug, Serialize, Deserialize)]
struct Meta {
    version: u32,
    count: u64,
    means: Means,
    scales: Coded,
    quats: Files,
    sh0: Coded,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    antialias: bool,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    harmonics: Option<Palette>,
}

/// The low and the high bytes of positions between bounds, after the logarithm.
#[derive(Debug, Serialize, Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

/// Places in a codebook.
#[derive(Debug, Serialize, Deserialize)]
struct Coded {
    codebook: Vec<f32>,
    files: [String; 1],
}

/// An image without a codebook.
#[derive(Debug, Serialize, Deserialize)]
struct Files {
    files: [String; 1],
}

/// The palette's image and that of the labels.
#[derive(Debug, Serialize, Deserialize)]
struct Palette {
    count: usize,
    bands: u8,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// The logarithm that positions are coded in.
fn compressed(value: f64) -> f64 {
    value.signum() * value.abs().ln_1p()
}

fn expanded(value: f64) -> f64 {
    value.signum() * value.abs().exp_m1()
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
