//! Disparities of keypoints in a row-aligned pair, to a fraction of a pixel (after Mur-Artal & Tardós, *ORB-SLAM2*, 2017, sec. III-A):
//! the most similar descriptor on the same row, then the shift that aligns the grey patches, whole pixels first.

use crate::tracking::TrackingError;
use crate::tracking::features::orb::{Keypoint, LevelImage, Pyramid};

/// Largest Hamming distance of a match.
const MAX_DISTANCE: u32 = 75;
/// Rows that a match may be off, pixels at its own level.
const ROW_BAND: f64 = 2.0;
/// Half the side of the patches that are compared, and how far they are shifted, pixels at the keypoint's level.
const PATCH: i64 = 10;
const SHIFT: i64 = 5;
/// Gauss-Newton steps of the sub-pixel alignment, and the variance of the gradient along the row that it needs, (grey levels/pixel)².
const REFINEMENTS: usize = 6;
const LEAST_TEXTURE: f64 = 1.0;
/// Pairs whose patches differ by more than this times the median are wrong.
const MAX_DIFFERENCE: f64 = 2.1;

/// One eye's keypoints, and the pyramid they were found in.
#[derive(Clone, Copy, Debug)]
pub struct Eye<'a> {
    pub keypoints: &'a [Keypoint],
    pub pyramid: &'a Pyramid,
}

/// The disparity of each left keypoint in pixels at full size, above 0 and at most `max_disparity`; `None` where no match is found.
pub fn disparities(
    left: Eye<'_>,
    right: Eye<'_>,
    max_disparity: f64,
    level_scale: f64,
) -> Result<Vec<Option<f64>>, TrackingError> {
    let rows = by_row(right.keypoints, level_scale);
    let mut found: Vec<Option<(f64, f64)>> = Vec::with_capacity(left.keypoints.len());
    for keypoint in left.keypoints {
        let candidates = rows.get(keypoint.pixel.y.round().max(0.0) as usize).map_or(&[][..], Vec::as_slice);
        let fits = |other: &Keypoint| {
            let disparity = keypoint.pixel.x - other.pixel.x;
            other.octave.abs_diff(keypoint.octave) <= 1 && disparity >= -1.0 && disparity <= max_disparity
        };
        let best = candidates
            .iter()
            .map(|i| &right.keypoints[*i])
            .filter(|other| fits(other))
            .min_by_key(|other| keypoint.descriptor.distance(&other.descriptor))
            .filter(|other| keypoint.descriptor.distance(&other.descriptor) < MAX_DISTANCE);
        let aligned = match best {
            Some(other) => align(keypoint, other.pixel.x, left.pyramid, right.pyramid)?,
            None => None,
        };
        found.push(aligned.filter(|(disparity, _)| *disparity > 0.0 && *disparity <= max_disparity));
    }
    let mut differences: Vec<f64> = found.iter().flatten().map(|(_, difference)| *difference).collect();
    differences.sort_by(f64::total_cmp);
    let limit = MAX_DIFFERENCE * differences.get(differences.len() / 2).copied().unwrap_or_default();
    Ok(found.into_iter().map(|f| f.filter(|(_, difference)| *difference <= limit).map(|(disparity, _)| disparity)).collect())
}

/// The keypoints that may match one on each row.
fn by_row(keypoints: &[Keypoint], level_scale: f64) -> Vec<Vec<usize>> {
    let mut rows: Vec<Vec<usize>> = Vec::new();
    for (i, keypoint) in keypoints.iter().enumerate() {
        let band = ROW_BAND * level_scale.powi(keypoint.octave.into());
        let first = (keypoint.pixel.y - band).ceil().max(0.0) as usize;
        let last = (keypoint.pixel.y + band).floor().max(0.0) as usize;
        if rows.len() <= last {
            rows.resize(last + 1, Vec::new());
        }
        rows[first..=last].iter_mut().for_each(|row| row.push(i));
    }
    rows
}

/// `(disparity, mean difference of the patches)` where the patches match best; `None` at the border, or without a clear minimum.
fn align(keypoint: &Keypoint, right_x: f64, left: &Pyramid, right: &Pyramid) -> Result<Option<(f64, f64)>, TrackingError> {
    let (full, level, other) = (left.level(0)?, left.level(keypoint.octave)?, right.level(keypoint.octave)?);
    let (sx, sy) = (level.width as f64 / full.width as f64, level.height as f64 / full.height as f64);
    // Pixel centres stay where they belong when an image is resized.
    let at_level = |v: f64, scale: f64| ((v + 0.5) * scale - 0.5).round() as i64;
    let (x, y) = (at_level(keypoint.pixel.x, sx), at_level(keypoint.pixel.y, sy));
    let start = at_level(right_x, sx);
    let inside = |image: &LevelImage<'_>, x: i64, reach: i64| {
        x - reach >= 0 && x + reach < image.width as i64 && y - PATCH >= 0 && y + PATCH < image.height as i64
    };
    if !inside(&level, x, PATCH) || !inside(&other, start, PATCH + SHIFT) {
        return Ok(None);
    }
    let differences: Vec<f64> = (-SHIFT..=SHIFT).map(|shift| difference(&level, x, &other, start + shift, y)).collect();
    let best = (0..differences.len()).min_by(|a, b| differences[*a].total_cmp(&differences[*b])).unwrap_or(0);
    if best == 0 || best + 1 == differences.len() {
        return Ok(None);
    }
    let nearest = start - SHIFT + best as i64;
    // Both are taken at the level, so that rounding the left position to a pixel of the level cancels.
    let aligned = refine(&level, x, &other, nearest, y).map(|shifted| ((x as f64 - shifted) / sx, differences[best]));
    Ok(aligned)
}

/// The position in the right image, to a fraction of a pixel, whose patch differs least from the left one's up to a constant: Gauss-Newton
/// on the shift and the offset (Lucas & Kanade 1981, along the row). `None` where it leads away from `nearest`.
fn refine(left: &LevelImage<'_>, left_x: i64, right: &LevelImage<'_>, nearest: i64, y: i64) -> Option<f64> {
    let mut shifted = nearest as f64;
    for _ in 0..REFINEMENTS {
        let (whole, part) = (shifted.floor() as i64, shifted - shifted.floor());
        if whole - PATCH - 1 < 0 || whole + PATCH + 2 >= right.width as i64 {
            return None;
        }
        let (mut count, mut sum_g, mut sum_gg, mut sum_e, mut sum_ge) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for v in -PATCH..=PATCH {
            let row = |image: &LevelImage<'_>| ((y + v) * image.width as i64) as usize;
            let (a, b) = (row(left), row(right));
            let at = |k: i64| f64::from(right.pixels[b + k as usize]);
            for u in -PATCH..=PATCH {
                let k = whole + u;
                let (before, here, next, after) = (at(k - 1), at(k), at(k + 1), at(k + 2));
                let value = here + part * (next - here);
                let gradient = 0.5 * ((1.0 - part) * (next - before) + part * (after - here));
                let error = f64::from(left.pixels[a + (left_x + u) as usize]) - value;
                count += 1.0;
                sum_g += gradient;
                sum_gg += gradient * gradient;
                sum_e += error;
                sum_ge += gradient * error;
            }
        }
        let spread = sum_gg - sum_g * sum_g / count;
        if spread < LEAST_TEXTURE * count {
            return None;
        }
        let step = (sum_ge - sum_g * sum_e / count) / spread;
        shifted += step;
        if (shifted - nearest as f64).abs() > 1.0 {
            return None;
        }
        if step.abs() < 1e-3 {
            break;
        }
    }
    Some(shifted)
}

/// Mean absolute difference of two patches, each less its own mean: an exposure that differs does not matter.
fn difference(left: &LevelImage<'_>, left_x: i64, right: &LevelImage<'_>, right_x: i64, y: i64) -> f64 {
    const COUNT: i32 = ((2 * PATCH + 1) * (2 * PATCH + 1)) as i32;
    let rows = || {
        (-PATCH..=PATCH).map(|v| {
            let row = |image: &LevelImage<'_>, x: i64| ((y + v) * image.width as i64 + x - PATCH) as usize;
            let (a, b) = (row(left, left_x), row(right, right_x));
            let side = 2 * PATCH as usize + 1;
            left.pixels[a..a + side].iter().zip(&right.pixels[b..b + side])
        })
    };
    let offset: i32 = rows().flatten().map(|(a, b)| i32::from(*a) - i32::from(*b)).sum();
    let sum: i32 = rows().flatten().map(|(a, b)| (COUNT * (i32::from(*a) - i32::from(*b)) - offset).abs()).sum();
    f64::from(sum) / f64::from(COUNT * COUNT)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::TrackingConfig;
    use crate::tracking::features::orb::Extractor;

    /// A smooth random picture, and the same seen `shift` pixels further left and a little darker.
    fn pair(shift: f64) -> (Vec<u8>, Vec<u8>) {
        let mut random = fastrand::Rng::with_seed(3);
        let waves: Vec<[f64; 4]> = (0..60)
            .map(|_| [random.f64() * 0.9 - 0.45, random.f64() * 0.9 - 0.45, random.f64() * std::f64::consts::TAU, random.f64()])
            .collect();
        let value = |x: f64, y: f64| 128.0 + 9.0 * waves.iter().map(|[a, b, c, d]| d * (a * x + b * y + c).sin()).sum::<f64>();
        let picture = |offset: f64, light: f64| {
            (0..320 * 240)
                .map(|i| (light * value(f64::from(i % 320) + offset, f64::from(i / 320))).clamp(0.0, 255.0) as u8)
                .collect()
        };
        (picture(0.0, 1.0), picture(shift, 0.95))
    }

    #[test]
    fn disparities_are_found_to_a_fraction_of_a_pixel() {
        let config = TrackingConfig::default();
        let extractor = Extractor::new(320, 240, 600, &config);
        let (left, right) = pair(12.3);
        let (left, right) = (extractor.pyramid(&left).unwrap(), extractor.pyramid(&right).unwrap());
        let (a, b) = (extractor.extract(&left).unwrap(), extractor.extract(&right).unwrap());
        let eye = |keypoints, pyramid| Eye { keypoints, pyramid };
        let found = disparities(eye(&a, &left), eye(&b, &right), 60.0, config.pyramid_scale).unwrap();
        let mut errors: Vec<f64> = found.iter().flatten().map(|d| (d - 12.3).abs()).collect();
        errors.sort_by(f64::total_cmp);
        assert!(errors.len() > a.len() / 3, "{} of {}", errors.len(), a.len());
        assert!(errors[errors.len() / 2] < 0.05, "median error {}", errors[errors.len() / 2]);
        assert!(errors[errors.len() * 9 / 10] < 0.3, "90% below {}", errors[errors.len() * 9 / 10]);
    }
}
