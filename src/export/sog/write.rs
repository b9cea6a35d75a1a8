//! Writes SOG.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use super::bundle::{Plane, Writer};
use super::codebook::Codebook;
use super::palette::Palette as Found;
use super::{
    Coded, ENTRIES_A_ROW, Files, LARGEST, META, MOST_CODE, Means, Meta, Palette, Precision, SogFile, VERSION, compressed,
};
use crate::export::ExportError;
use crate::export::harmonics::{Seen, channel};
use crate::geometry::Se3;
use crate::splat::{GaussianCloud, opacity_from_raw, unit_rotation};

/// Sides of WebP images are at most 16,383, and ours multiples of four.
const MOST_GAUSSIANS: usize = 16_380 * 16_380;
/// Harmonics beyond are cut off: their squares and sums stay finite.
const MOST_HARMONIC: f32 = 1e4;

/// The whole file, for cameras at these poses (world from camera), which may be none.
pub(super) fn encode(cloud: &GaussianCloud, cameras: &[Se3], precision: &Precision) -> Result<Vec<u8>, ExportError> {
    check(cloud)?;
    let sorted = cloud.picked(super::morton::image_order(&cloud.means, Plane::width(cloud.len())).into_iter());
    let files = encode_files(sorted, cameras, precision)?;
    bundle(&files).map_err(|reason| ExportError::Encode { reason })
}

/// The images and the description, which is the last, of a map in its order.
pub(super) fn encode_files(cloud: GaussianCloud, cameras: &[Se3], precision: &Precision) -> Result<Vec<SogFile>, ExportError> {
    check(&cloud)?;
    files(cloud, cameras, precision).map_err(|reason| ExportError::Encode { reason })
}

fn check(cloud: &GaussianCloud) -> Result<(), ExportError> {
    if let Some(index) = cloud.first_non_finite() {
        return Err(ExportError::NonFinite { index });
    }
    if cloud.len() > MOST_GAUSSIANS {
        return Err(ExportError::Encode { reason: format!("SOG holds {MOST_GAUSSIANS} Gaussians at most") });
    }
    Ok(())
}

fn bundle(files: &[SogFile]) -> Result<Vec<u8>, String> {
    let mut zip = Writer::new();
    for SogFile { name, bytes } in files {
        if *name == META { zip.add_deflated(name, bytes)? } else { zip.add(name, bytes)? }
    }
    zip.finish()
}

fn files(mut cloud: GaussianCloud, cameras: &[Se3], precision: &Precision) -> Result<Vec<SogFile>, String> {
    cloud.sh.iter_mut().for_each(|c| *c = c.clamp(Vec3::splat(-MOST_HARMONIC), Vec3::splat(MOST_HARMONIC)));
    let mut images = Vec::new();
    let has_harmonics = cloud.sh_degree.get() > 0;
    let harmonics = if has_harmonics { Some(add_harmonics(&mut images, &mut cloud, cameras, precision)?) } else { None };
    let count = cloud.len();
    let means = add_means(&mut images, &cloud, precision.position_step)?;
    add(&mut images, "quats.webp", &Plane::of(count, |i| smallest_three(cloud.rotations[i], precision.rotation_step)))?;
    let scales = Codebook::new(cloud.log_scales.iter().flat_map(|scale| scale.to_array()), precision.scale_step);
    let coded = |codebook: &Codebook, values: Vec3, last: u8| {
        let [r, g, b] = values.to_array().map(|value| codebook.place(value));
        [r, g, b, last]
    };
    add(&mut images, "scales.webp", &Plane::of(count, |i| coded(&scales, cloud.log_scales[i], 255)))?;
    let coefficients = cloud.sh_degree.coefficients();
    let constants: Vec<Vec3> = cloud.sh.chunks(coefficients).map(|sh| sh[0]).collect();
    let colors = Codebook::new(constants.iter().flat_map(|constant| constant.to_array()), precision.constant_step);
    let opacity = |i: usize| (opacity_from_raw(cloud.raw_opacities[i]) * 255.0).round() as u8;
    add(&mut images, "sh0.webp", &Plane::of(count, |i| coded(&colors, constants[i], opacity(i))))?;
    let meta = Meta {
        version: VERSION,
        count: count as u64,
        means,
        scales: Coded { codebook: scales.0, files: ["scales.webp".into()] },
        quats: Files { files: ["quats.webp".into()] },
        antialias: cloud.antialiased,
        sh0: Coded { codebook: colors.0, files: ["sh0.webp".into()] },
        harmonics,
    };
    images.push(SogFile { name: META, bytes: serde_json::to_vec(&meta).map_err(|error| error.to_string())? });
    Ok(images)
}

fn add(images: &mut Vec<SogFile>, name: &'static str, plane: &Plane) -> Result<(), String> {
    images.push(SogFile { name, bytes: plane.encode()? });
    Ok(())
}

/// Median of the Gaussians' least extents, metres.
fn median_extent(cloud: &GaussianCloud) -> f64 {
    let mut least: Vec<f32> = cloud.log_scales.iter().map(|scale| scale.min_element()).collect();
    let middle = least.len() / 2;
    if least.is_empty() { 0.0 } else { f64::from(*least.select_nth_unstable_by(middle, f32::total_cmp).1).exp() }
}

fn add_means(images: &mut Vec<SogFile>, cloud: &GaussianCloud, position_step: f64) -> Result<Means, String> {
    let means = &cloud.means;
    let logs: Vec<[f64; 3]> = means.iter().map(|mean| mean.to_array().map(|v| compressed(f64::from(v)))).collect();
    let bound = |k: usize, pick: fn(f64, f64) -> f64| logs.iter().map(|log| log[k]).reduce(pick).unwrap_or(0.0);
    let (mins, maxs) = ([0, 1, 2].map(|k| bound(k, f64::min)), [0, 1, 2].map(|k| bound(k, f64::max)));
    let extent = median_extent(cloud);
    let code = |i: usize| {
        [0, 1, 2].map(|k| {
            let span = maxs[k] - mins[k];
            // Steps grow with the distance from the origin.
            let step = span / MOST_CODE * (1.0 + f64::from(cloud.means[i][k].abs()));
            let steps = (position_step * extent / step).clamp(1.0, 256.0).log2().floor().exp2();
            let code = ((logs[i][k] - mins[k]) / span * MOST_CODE / steps).round() * steps;
            if span > 0.0 { code.min(MOST_CODE) as u16 } else { 0 }
        })
    };
    let half = |shift: u32| {
        Plane::of(means.len(), |i| {
            let [x, y, z] = code(i).map(|code| (code >> shift) as u8);
            [x, y, z, 255]
        })
    };
    add(images, "means_l.webp", &half(0))?;
    add(images, "means_u.webp", &half(8))?;
    Ok(Means { mins, maxs, files: ["means_l.webp".into(), "means_u.webp".into()] })
}

/// Three bytes for the components but the largest, in the order of w, x, y and z, and one that says which that is. The bytes are whole steps.
fn smallest_three(rotation: Quat, step: u8) -> [u8; 4] {
    let [x, y, z, w] = unit_rotation(rotation).to_array();
    let q = [w, x, y, z];
    let largest = (0..4).fold(0, |largest, k| if q[k].abs() > q[largest].abs() { k } else { largest });
    let scale = if q[largest] < 0.0 { -std::f32::consts::SQRT_2 } else { std::f32::consts::SQRT_2 };
    let mut bytes = [LARGEST + largest as u8; 4];
    let others = (0..4).filter(|k| *k != largest);
    let step = f32::from(step);
    let coded = |component: f32| (((component * scale * 0.5 + 0.5) * 255.0 / step).round() * step).min(255.0) as u8;
    others.zip(&mut bytes).for_each(|(k, byte)| *byte = coded(q[k]));
    bytes
}

/// Adds the palette and its labels. The constant harmonics then make up for what the palette changes in the cameras' views.
fn add_harmonics(
    images: &mut Vec<SogFile>,
    cloud: &mut GaussianCloud,
    cameras: &[Se3],
    precision: &Precision,
) -> Result<Palette, String> {
    let found = Found::new(cloud, cameras, precision);
    let coefficients = cloud.sh_degree.coefficients();
    let dimensions = 3 * (coefficients - 1);
    let codebook = Codebook::new(found.entries.iter().copied(), precision.harmonic_step);
    let entries: Vec<f32> = found.entries.iter().map(|value| codebook.nearest(*value)).collect();
    let means = &cloud.means;
    cloud.sh.par_chunks_mut(coefficients).enumerate().for_each(|(i, sh)| {
        let entry = &entries[usize::from(found.labels[i]) * dimensions..][..dimensions];
        let rest: Vec<Vec3> = entry.chunks(3).map(Vec3::from_slice).collect();
        let seen = Seen::new(means[i], cameras);
        let coded: Vec<Vec3> = std::iter::once(sh[0]).chain(rest).collect();
        let constant = [0, 1, 2].map(|c| seen.constant(&channel(sh, c), &channel(&coded, c)) as f32);
        sh.copy_from_slice(&coded);
        sh[0] = Vec3::from(constant);
    });
    let count = entries.len() / dimensions;
    let (width, height) = (ENTRIES_A_ROW * (coefficients - 1), count.div_ceil(ENTRIES_A_ROW).max(1));
    let pixels = entries.chunks(3).map(|rgb| [codebook.place(rgb[0]), codebook.place(rgb[1]), codebook.place(rgb[2]), 255]);
    let mut pixels: Vec<[u8; 4]> = pixels.collect();
    pixels.resize(width * height, [0, 0, 0, 255]);
    add(images, "shN_centroids.webp", &Plane { width, height, pixels })?;
    let label = |i: usize| {
        let [low, high] = found.labels[i].to_le_bytes();
        // Blue is not read; equal to green it costs nothing.
        [low, high, high, 255]
    };
    add(images, "shN_labels.webp", &Plane::of(cloud.len(), label))?;
    let files = ["shN_centroids.webp".into(), "shN_labels.webp".into()];
    Ok(Palette { count, bands: cloud.sh_degree.get(), codebook: codebook.0, files })
}
