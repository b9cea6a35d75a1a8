//! Reads SOG.

use std::io::{BufRead, Read};
use std::path::Path;

use glam::{Quat, Vec3};
use serde::Deserialize;

use super::bundle::{Plane, Reader};
use super::palette::MOST_ENTRIES;
use super::{Coded, ENTRIES_A_ROW, LARGEST, META, MOST_CODE, Meta, Palette, VERSION, expanded};
use crate::export::{ExportError, FileSize};
use crate::splat::{Gaussian, GaussianCloud, ShDegree, raw_opacity_of_byte};

/// Gaussians per byte of a file, at most: honest ones take ten bytes and more, unless few of them are all alike.
const MOST_PER_BYTE: u64 = 4;
const FEW: u64 = 1 << 16;

pub(super) fn decode(reader: &mut dyn BufRead, FileSize(size): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let mut bytes = Vec::new();
    reader.take(size).read_to_end(&mut bytes).map_err(|source| ExportError::Read { path: path.into(), source })?;
    unpack(&bytes).map_err(|what| ExportError::Damaged { path: path.into(), what })
}

/// What all versions have.
#[derive(Deserialize)]
struct Versioned {
    version: Option<u32>,
}

fn unpack(bytes: &[u8]) -> Result<GaussianCloud, String> {
    let mut zip = Reader::new(bytes)?;
    let text = zip.entry(META)?;
    let wrong = |error: serde_json::Error| format!("{META}: {error}");
    match serde_json::from_slice::<Versioned>(&text).map_err(wrong)?.version {
        Some(VERSION) => {}
        version => return Err(format!("SOG version {} is not read; convert it to version 2, or to PLY", version.unwrap_or(1))),
    }
    let meta: Meta = serde_json::from_slice(&text).map_err(wrong)?;
    if meta.count > bytes.len() as u64 * MOST_PER_BYTE + FEW {
        return Err(format!("{} Gaussians are promised, more than the file can hold", meta.count));
    }
    let count = meta.count as usize;
    let means = [zip.plane(&meta.means.files[0], count)?, zip.plane(&meta.means.files[1], count)?];
    let quats = zip.plane(&meta.quats.files[0], count)?;
    let scales = Indexed::new(&mut zip, &meta.scales, count)?;
    let colors = Indexed::new(&mut zip, &meta.sh0, count)?;
    let harmonics = meta.harmonics.as_ref().map(|palette| Harmonics::new(&mut zip, palette, count)).transpose()?;
    let degree = harmonics.as_ref().map_or(ShDegree::default(), |harmonics| harmonics.degree);
    let mut cloud = GaussianCloud { antialiased: meta.antialias, ..GaussianCloud::new(degree) };
    for i in 0..count {
        let mut sh = vec![colors.of(i)?];
        if let Some(harmonics) = &harmonics {
            sh.extend(harmonics.of(i)?);
        }
        cloud.push(Gaussian {
            mean: mean(&meta, [means[0].pixels[i], means[1].pixels[i]]),
            log_scale: scales.of(i)?,
            rotation: rotation(quats.pixels[i]).ok_or_else(|| format!("the rotation of Gaussian {i} is none"))?,
            raw_opacity: raw_opacity_of_byte(colors.plane.pixels[i][3]),
            sh,
        });
    }
    match cloud.first_non_finite() {
        Some(i) => Err(format!("Gaussian {i} is not finite")),
        None => Ok(cloud),
    }
}

/// An image of places in a codebook.
struct Indexed<'a> {
    plane: Plane,
    codebook: &'a [f32],
}

impl<'a> Indexed<'a> {
    fn new(zip: &mut Reader<'_>, coded: &'a Coded, count: usize) -> Result<Self, String> {
        Ok(Self { plane: zip.plane(&coded.files[0], count)?, codebook: &coded.codebook })
    }

    fn of(&self, i: usize) -> Result<Vec3, String> {
        values(self.codebook, self.plane.pixels[i])
    }
}

/// Red, green and blue looked up.
fn values(codebook: &[f32], pixel: [u8; 4]) -> Result<Vec3, String> {
    let value = |place: u8| codebook.get(usize::from(place)).copied();
    let found = value(pixel[0]).zip(value(pixel[1])).zip(value(pixel[2]));
    let ((r, g), b) = found.ok_or_else(|| format!("a codebook has {} places, too few", codebook.len()))?;
    Ok(Vec3::new(r, g, b))
}

/// Palette and labels.
struct Harmonics<'a> {
    degree: ShDegree,
    entries: usize,
    codebook: &'a [f32],
    palette: Plane,
    labels: Plane,
}

impl<'a> Harmonics<'a> {
    fn new(zip: &mut Reader<'_>, meta: &'a Palette, count: usize) -> Result<Self, String> {
        let degree = ShDegree::new(meta.bands).filter(|degree| degree.get() > 0);
        let degree = degree.ok_or_else(|| format!("harmonics of degree {} are not read", meta.bands))?;
        if meta.count > MOST_ENTRIES {
            return Err(format!("a palette of {} entries is larger than its labels reach", meta.count));
        }
        let width = ENTRIES_A_ROW * (degree.coefficients() - 1);
        let palette = zip.plane(&meta.files[0], meta.count.div_ceil(ENTRIES_A_ROW) * width)?;
        if palette.width != width {
            return Err(format!("{} is {} pixels wide, not {width}", meta.files[0], palette.width));
        }
        let labels = zip.plane(&meta.files[1], count)?;
        Ok(Self { degree, entries: meta.count, codebook: &meta.codebook, palette, labels })
    }

    fn of(&self, i: usize) -> Result<Vec<Vec3>, String> {
        let [low, high, ..] = self.labels.pixels[i];
        let label = usize::from(u16::from_le_bytes([low, high]));
        if label >= self.entries {
            return Err(format!("the label of Gaussian {i} is {label}, beyond the palette's {} entries", self.entries));
        }
        let beyond = self.degree.coefficients() - 1;
        let at = label / ENTRIES_A_ROW * self.palette.width + label % ENTRIES_A_ROW * beyond;
        self.palette.pixels[at..at + beyond].iter().map(|pixel| values(self.codebook, *pixel)).collect()
    }
}

/// A position of its low and high bytes.
fn mean(meta: &Meta, [low, high]: [[u8; 4]; 2]) -> Vec3 {
    Vec3::from([0, 1, 2].map(|k| {
        let (least, most) = (meta.means.mins[k], meta.means.maxs[k]);
        let code = f64::from(u16::from_le_bytes([low[k], high[k]]));
        expanded(least + (most - least) * (code / MOST_CODE)) as f32
    }))
}

/// A rotation; none where no byte says which component is the largest.
fn rotation(pixel: [u8; 4]) -> Option<Quat> {
    let largest = usize::from(pixel[3].checked_sub(LARGEST)?);
    let mut q = [0f32; 4];
    let others = (0..4).filter(|k| *k != largest);
    others.zip(pixel).for_each(|(k, byte)| q[k] = (f32::from(byte) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let [w, x, y, z] = q;
    Some(Quat::from_xyzw(x, y, z, w).normalize())
}
