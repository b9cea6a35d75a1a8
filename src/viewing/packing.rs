//! A map as viewers receive it: Gaussians as 32-bit words, in chunks of a grid (docs/view-protocol.md, `map`).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::{Quat, Vec3};

use crate::splat::{GaussianCloud, ShDegree, opacity_from_raw, unit_rotation};

/// Most Gaussians of a part of a chunk.
pub const MOST_IN_PART: usize = 4096;
/// A grid has at most this many occupied cells,
const MOST_CELLS: usize = 64;
/// and is kept while it has at least this many, or so many that an update stays small.
const FEWEST_CELLS: usize = 8;
/// Gaussians that the grid's width is chosen by.
const SAMPLES: usize = 4096;
/// Exponents of two of the widths that a grid may have, metres.
const WIDTHS: std::ops::RangeInclusive<i32> = -10..=20;
/// Range of the log scales.
const LOG_SCALES: (f32, f32) = (-16.0, 8.0);

/// A part of a chunk, by its cell and number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PartId {
    /// Cell of the grid.
    pub at: [i32; 3],
    /// Counts from 0 within the cell.
    pub part: u32,
}

/// Packed Gaussians of one part.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Its place.
    pub id: PartId,
    /// Gaussians in it.
    pub count: usize,
    /// Largest magnitude of its harmonics beyond the constant one.
    pub sh_scale: f32,
    /// `[count, 8 + 4·degree]`
    pub words: Vec<u32>,
    /// Equal for equal content, whatever the snapshot.
    pub digest: u64,
}

/// A packed snapshot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PackedMap {
    /// Number of the snapshot.
    pub revision: u64,
    /// Degree of the harmonics.
    pub sh_degree: ShDegree,
    /// See [`GaussianCloud::antialiased`].
    pub antialiased: bool,
    /// Exponent of two of the grid's width in metres.
    pub width: i32,
    /// Gaussians of all parts.
    pub gaussians: usize,
    /// Ascending by id.
    pub parts: Vec<Arc<Part>>,
}

impl PackedMap {
    /// Packs the finite Gaussians of a map. The grid of `last` is kept while it suits.
    pub fn new(cloud: &GaussianCloud, revision: u64, last: Option<&Self>) -> Self {
        let width = grid_width(cloud, last.map(|last| last.width));
        let mut cells: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
        for (i, mean) in cloud.means.iter().enumerate() {
            if let Some(cell) = cell_of(*mean, width).filter(|_| is_finite(cloud, i)) {
                cells.entry(cell).or_default().push(i as u32);
            }
        }
        let parts = cells.iter().flat_map(|(at, members)| {
            let packed = move |(part, members): (usize, &[u32])| {
                Arc::new(Part::new(PartId { at: *at, part: part as u32 }, cloud, members))
            };
            members.chunks(MOST_IN_PART).enumerate().map(packed)
        });
        let parts: Vec<Arc<Part>> = parts.collect();
        let gaussians = parts.iter().map(|part| part.count).sum();
        Self { revision, sh_degree: cloud.sh_degree, antialiased: cloud.antialiased, width, gaussians, parts }
    }

    /// Width of a cell, metres.
    pub fn cell_metres(&self) -> f64 {
        2f64.powi(self.width)
    }

    /// Sum of all words modulo 2³², as the page computes it of what it holds.
    pub fn digest(&self) -> u32 {
        self.parts.iter().flat_map(|part| &part.words).fold(0u32, |sum, word| sum.wrapping_add(*word))
    }
}

/// Words of 32 bits that a Gaussian takes.
pub fn words_per_gaussian(degree: ShDegree) -> usize {
    8 + 4 * usize::from(degree.get())
}

fn is_finite(cloud: &GaussianCloud, i: usize) -> bool {
    let harmonics = cloud.sh_degree.coefficients();
    let finite = cloud.log_scales[i].is_finite() && cloud.rotations[i].is_finite() && cloud.raw_opacities[i].is_finite();
    finite && cloud.sh[i * harmonics..(i + 1) * harmonics].iter().all(|c| c.is_finite())
}

/// The cell of a point; `None` where it is not finite or too far away.
fn cell_of(mean: Vec3, width: i32) -> Option<[i32; 3]> {
    let cell = (mean / 2f32.powi(width)).floor();
    let fits = mean.is_finite() && cell.abs().max_element() < (i32::MAX / 2) as f32;
    fits.then(|| cell.to_array().map(|c| c as i32))
}

/// The narrowest grid of few enough cells; the last one's while its number of cells suits.
fn grid_width(cloud: &GaussianCloud, last: Option<i32>) -> i32 {
    let stride = cloud.len().div_ceil(SAMPLES).max(1);
    let cells = |width| {
        let sampled = cloud.means.iter().step_by(stride);
        sampled.filter_map(|mean| cell_of(*mean, width)).collect::<BTreeSet<_>>().len()
    };
    let suits = |width: &i32| (FEWEST_CELLS..=2 * MOST_CELLS).contains(&cells(*width));
    last.filter(suits).or_else(|| WIDTHS.into_iter().find(|width| cells(*width) <= MOST_CELLS)).unwrap_or(*WIDTHS.end())
}

impl Part {
    fn new(id: PartId, cloud: &GaussianCloud, members: &[u32]) -> Self {
        let harmonics = cloud.sh_degree.coefficients();
        let beyond = |i: u32| &cloud.sh[i as usize * harmonics + 1..(i as usize + 1) * harmonics];
        let sh_scale = members.iter().flat_map(|i| beyond(*i)).fold(0f32, |most, c| most.max(c.abs().max_element()));
        let mut words = Vec::with_capacity(members.len() * words_per_gaussian(cloud.sh_degree));
        for &member in members {
            let i = member as usize;
            let [x, y, z] = cloud.log_scales[i].to_array().map(log_scale_bits);
            let opacity = unorm16(opacity_from_raw(cloud.raw_opacities[i]));
            let [red, green, blue] = cloud.sh[i * harmonics].to_array().map(half_bits);
            words.extend(cloud.means[i].to_array().map(f32::to_bits));
            words.extend([opacity | x << 16, y | z << 16, rotation_bits(cloud.rotations[i]), red | green << 16, blue]);
            harmonic_words(beyond(member), sh_scale, 4 * usize::from(cloud.sh_degree.get()), &mut words);
        }
        let digest = digest(&words, sh_scale);
        Self { id, count: members.len(), sh_scale, words, digest }
    }
}

fn unorm16(value: f32) -> u32 {
    (value.clamp(0.0, 1.0) * 65535.0).round() as u32
}

fn log_scale_bits(log_scale: f32) -> u32 {
    unorm16((log_scale - LOG_SCALES.0) / (LOG_SCALES.1 - LOG_SCALES.0))
}

/// Smallest three: 10 bits a component, and the index of the largest one, which is made positive and left out.
fn rotation_bits(rotation: Quat) -> u32 {
    // As files have it, so that a map and its file are packed alike.
    let components = unit_rotation(rotation).to_array();
    let largest = (0..4).fold(0, |largest, k| if components[k].abs() > components[largest].abs() { k } else { largest });
    let sign = components[largest].signum();
    let kept = (0..4).filter(|k| *k != largest).enumerate();
    let bits = kept.map(|(place, k)| {
        let share = (sign * components[k]).mul_add(std::f32::consts::FRAC_1_SQRT_2, 0.5);
        ((share.clamp(0.0, 1.0) * 1023.0).round() as u32) << (10 * place)
    });
    bits.sum::<u32>() | (largest as u32) << 30
}

/// Harmonics beyond the constant one as bytes, padded to `count` words.
fn harmonic_words(coefficients: &[Vec3], scale: f32, count: usize, words: &mut Vec<u32>) {
    let per_unit = if scale > 0.0 { 127.0 / scale } else { 0.0 };
    let bytes = coefficients.iter().flat_map(|c| c.to_array()).map(|v| (v * per_unit).round().clamp(-127.0, 127.0) as i8 as u8);
    let start = words.len();
    words.resize(start + count, 0);
    bytes.enumerate().for_each(|(k, byte)| words[start + k / 4] |= u32::from(byte) << (8 * (k % 4)));
}

/// IEEE 754 binary16, rounded to nearest; beyond its range the largest finite value.
fn half_bits(value: f32) -> u32 {
    const LARGEST: f32 = 65504.0;
    let value = value.clamp(-LARGEST, LARGEST);
    let (sign, magnitude) = ((value.to_bits() >> 16) & 0x8000, value.abs());
    // A product with 2⁻¹¹² moves the exponent's bias from f32's to f16's; small numbers become subnormal on the way.
    let scaled = (magnitude * f32::from_bits(0x0780_0000)).to_bits();
    let rounded = (scaled + 0x0FFF + ((scaled >> 13) & 1)) >> 13;
    sign | rounded.min(0x7BFF)
}

/// FNV-1a over the words.
fn digest(words: &[u32], sh_scale: f32) -> u64 {
    let all = words.iter().copied().chain([sh_scale.to_bits()]);
    all.fold(0xcbf2_9ce4_8422_2325, |hash, word| (hash ^ u64::from(word)).wrapping_mul(0x0000_0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::splat::Gaussian;

    fn half(bits: u32) -> f32 {
        let (sign, exponent, fraction) = (bits >> 15, (bits >> 10) & 31, (bits & 1023) as f32 / 1024.0);
        let magnitude =
            if exponent == 0 { fraction * 2f32.powi(-14) } else { (1.0 + fraction) * 2f32.powi(exponent as i32 - 15) };
        if sign == 1 { -magnitude } else { magnitude }
    }

    fn rotation(bits: u32) -> Quat {
        let largest = (bits >> 30) as usize;
        let mut components = [0f32; 4];
        for (place, k) in (0..4).filter(|k| *k != largest).enumerate() {
            let value = ((bits >> (10 * place)) & 1023) as f32 / 1023.0;
            components[k] = value * std::f32::consts::SQRT_2 - std::f32::consts::FRAC_1_SQRT_2;
        }
        components[largest] = (1.0 - components.iter().map(|c| c * c).sum::<f32>()).max(0.0).sqrt();
        Quat::from_array(components)
    }

    fn cloud(gaussians: usize, degree: u8) -> GaussianCloud {
        let mut random = fastrand::Rng::with_seed(3);
        let mut cloud = GaussianCloud::new(ShDegree::new(degree).unwrap());
        for _ in 0..gaussians {
            let mut vector = || Vec3::new(random.f32(), random.f32(), random.f32()) - 0.5;
            let gaussian = Gaussian {
                mean: vector() * 10.0,
                log_scale: vector() - 4.0,
                rotation: Quat::from_scaled_axis(vector() * 6.0),
                raw_opacity: vector().x * 8.0,
                sh: (0..16).map(|_| vector()).collect(),
            };
            cloud.push(gaussian);
        }
        cloud
    }

    proptest! {
        #[test]
        fn halves_are_the_nearest(value in -70000f32..70000.0, exponent in -30i32..1) {
            let value = value * 2f32.powi(exponent);
            let bits = half_bits(value);
            let clamped = value.clamp(-65504.0, 65504.0);
            prop_assert!((half(bits) - clamped).abs() <= (clamped.abs() / 2048.0).max(2f32.powi(-25)), "{value} {bits:x}");
        }

        #[test]
        fn rotations_keep_their_direction(axis in prop::array::uniform3(-7f32..7.0), length in 0.1f32..10.0) {
            let original = Quat::from_scaled_axis(axis.into());
            let back = rotation(rotation_bits(original * length));
            prop_assert!(back.dot(original).abs() > 1.0 - 5e-6, "{original} {back}");
        }
    }

    #[test]
    fn every_gaussian_is_in_one_part_with_its_values() {
        for degree in 0..=3 {
            let cloud = cloud(3000, degree);
            let packed = PackedMap::new(&cloud, 7, None);
            let stride = words_per_gaussian(cloud.sh_degree);
            assert_eq!((packed.gaussians, packed.revision), (3000, 7));
            assert!((FEWEST_CELLS..=2 * MOST_CELLS).contains(&packed.parts.len()), "{}", packed.parts.len());
            assert!(packed.parts.is_sorted_by(|a, b| a.id < b.id));
            let mut found = BTreeSet::new();
            for part in &packed.parts {
                assert_eq!(part.words.len(), part.count * stride);
                for words in part.words.chunks(stride) {
                    let mean = Vec3::new(f32::from_bits(words[0]), f32::from_bits(words[1]), f32::from_bits(words[2]));
                    assert_eq!(cell_of(mean, packed.width), Some(part.id.at));
                    let i = cloud.means.iter().position(|m| *m == mean).unwrap();
                    assert!(found.insert(i));
                    let opacity = (words[3] & 0xFFFF) as f32 / 65535.0;
                    assert!((opacity - opacity_from_raw(cloud.raw_opacities[i])).abs() < 1e-5);
                    let scale = |bits: u32| bits as f32 / 65535.0 * 24.0 - 16.0;
                    let scales = Vec3::new(scale(words[3] >> 16), scale(words[4] & 0xFFFF), scale(words[4] >> 16));
                    assert!(scales.distance(cloud.log_scales[i]) < 4e-4);
                    assert!(rotation(words[5]).dot(cloud.rotations[i]).abs() > 1.0 - 5e-6);
                    let sh = cloud.get(i).sh;
                    let constant = Vec3::new(half(words[6] & 0xFFFF), half(words[6] >> 16), half(words[7]));
                    assert!(constant.distance(sh[0]) < 1e-3);
                    let byte = |k: usize| f32::from((words[8 + k / 4] >> (8 * (k % 4))) as u8 as i8) / 127.0 * part.sh_scale;
                    let harmonics = sh[1..].iter().flat_map(|c| c.to_array());
                    harmonics.enumerate().for_each(|(k, value)| assert!((byte(k) - value).abs() <= part.sh_scale / 250.0));
                }
            }
            assert_eq!(found.len(), 3000);
        }
    }

    #[test]
    fn parts_are_bounded_and_bad_gaussians_are_left_out() {
        let mut cloud = cloud(10, 1);
        for _ in 0..MOST_IN_PART + 5 {
            cloud.push(Gaussian { mean: Vec3::splat(2.0), ..cloud.get(0) });
        }
        cloud.push(Gaussian { mean: Vec3::NAN, ..cloud.get(0) });
        cloud.push(Gaussian { raw_opacity: f32::INFINITY, ..cloud.get(0) });
        let packed = PackedMap::new(&cloud, 1, None);
        assert_eq!(packed.gaussians, cloud.len() - 2);
        assert!(packed.parts.iter().all(|part| part.count <= MOST_IN_PART));
        assert!(packed.parts.iter().any(|part| part.id.part == 1));
    }

    #[test]
    fn a_grid_stays_while_the_map_grows_and_its_unchanged_parts_are_equal() {
        let small = cloud(2000, 1);
        let first = PackedMap::new(&small, 1, None);
        let mut grown = small.clone();
        grown.push(Gaussian { mean: Vec3::splat(4.9), ..small.get(0) });
        let second = PackedMap::new(&grown, 2, Some(&first));
        assert_eq!(first.width, second.width);
        let digests: BTreeSet<u64> = first.parts.iter().map(|part| part.digest).collect();
        assert_eq!(second.parts.iter().filter(|part| !digests.contains(&part.digest)).count(), 1);
        let mut huge = small.clone();
        huge.means.iter_mut().for_each(|mean| *mean *= 1000.0);
        assert_eq!(PackedMap::new(&huge, 3, Some(&first)).width, first.width + 10);
    }
}
