//! Disparities of keypoints in a row-aligned pair, to a fraction of a pixel: the shift along the row, at the keypoint's own level, that aligns the grey
//! patches, whole pixels first. The right image needs no keypoints: a corner of one image need not be one of the other.

use rayon::prelude::*;

use crate::tracking::TrackingError;
use crate::tracking::features::orb::{Keypoint, LevelImage, Pyramid};

/// Half the side of the patches that are searched, and of those that are compared at last, pixels at the keypoint's level.
const SEARCH: i64 = 5;
const PATCH: i64 = 10;
/// The best shift must differ less than this share of any that is farther from it than a corner is wide.
const UNIQUE: f64 = 0.8;
const CORNER: usize = 2;
/// Gauss-Newton steps of the sub-pixel alignment, and the variance of the gradient along the row that it needs, (grey levels/pixel)².
const REFINEMENTS: usize = 6;
const LEAST_TEXTURE: f64 = 1.0;
/// Pairs whose patches differ by more than this times the median are wrong.
const MAX_DIFFERENCE: f64 = 2.1;

/// The disparity of each keypoint of the left image in pixels at full size, above 0 and at most `max_disparity`; `None` where no match is found.
///
/// # Errors
/// If OpenCV fails.
pub fn disparities(
    keypoints: &[Keypoint],
    left: &Pyramid,
    right: &Pyramid,
    max_disparity: f64,
) -> Result<Vec<Option<f64>>, TrackingError> {
    let match_one = |keypoint: &Keypoint| align(keypoint, left, right, max_disparity);
    let found: Vec<Option<(f64, f64)>> = keypoints.par_iter().map(match_one).collect::<Result<_, _>>()?;
    let mut differences: Vec<f64> = found.iter().flatten().map(|(_, difference)| *difference).collect();
    differences.sort_by(f64::total_cmp);
    let limit = MAX_DIFFERENCE * differences.get(differences.len() / 2).copied().unwrap_or_default();
    Ok(found.into_iter().map(|f| f.filter(|(_, difference)| *difference <= limit).map(|(disparity, _)| disparity)).collect())
}

/// `(disparity, mean difference of the patches)` where the patches match best; `None` at the border, or without a clear minimum.
fn align(keypoint: &Keypoint, left: &Pyramid, right: &Pyramid, max_disparity: f64) -> Result<Option<(f64, f64)>, TrackingError> {
    let (full, level, other) = (left.level(0)?, left.level(keypoint.octave)?, right.level(keypoint.octave)?);
    let (sx, sy) = (level.width as f64 / full.width as f64, level.height as f64 / full.height as f64);
    // Pixel centres stay where they belong when an image is resized.
    let at_level = |v: f64, scale: f64| ((v + 0.5) * scale - 0.5).round() as i64;
    let (x, y) = (at_level(keypoint.pixel.x, sx), at_level(keypoint.pixel.y, sy));
    let inside = |x: i64| x - PATCH >= 0 && x + PATCH < level.width as i64 && y - PATCH >= 0 && y + PATCH < level.height as i64;
    let farthest = (max_disparity * sx) as i64;
    let nearest = if inside(x) { search(&level, x, &other, y, farthest) } else { None };
    let Some(nearest) = nearest.filter(|nearest| inside(*nearest)) else { return Ok(None) };
    // Both are taken at the level, so that rounding the left position to a pixel of the level cancels.
    let shifted = refine(&level, x, &other, nearest, y);
    let disparity = shifted.map(|shifted| (x as f64 - shifted) / sx).filter(|d| *d > 0.0 && *d <= max_disparity);
    Ok(disparity.map(|disparity| (disparity, difference(&level, x, &other, nearest, y))))
}

/// The pixel of the right image's row, at most `farthest` to the left, whose patch differs least from the left image's at `left_x`, which lies inside;
/// `None` at either end of the range, or where another is nearly as good.
fn search(left: &LevelImage<'_>, left_x: i64, right: &LevelImage<'_>, y: i64, farthest: i64) -> Option<i64> {
    const SIDE: usize = 2 * SEARCH as usize + 1;
    const COUNT: i32 = (SIDE * SIDE) as i32;
    let first = (left_x - farthest - 1).max(SEARCH);
    let last = (left_x + 1).min(right.width as i64 - 1 - SEARCH);
    if last - first < 2 {
        return None;
    }
    let count = (last - first + 1) as usize;
    let row = |image: &LevelImage<'_>, v: i64, x: i64| ((y + v) * image.width as i64 + x - SEARCH) as usize;
    let rows = || {
        (-SEARCH..=SEARCH)
            .map(|v| (&left.pixels[row(left, v, left_x)..][..SIDE], &right.pixels[row(right, v, first)..][..count + SIDE - 1]))
    };
    // Each patch less its own mean: an exposure that differs does not matter.
    let mut columns = vec![0i32; count + SIDE - 1];
    let mut left_sum = 0;
    for (a, b) in rows() {
        left_sum += a.iter().map(|value| i32::from(*value)).sum::<i32>();
        columns.iter_mut().zip(b).for_each(|(sum, value)| *sum += i32::from(*value));
    }
    let offsets: Vec<i16> =
        columns.windows(SIDE).map(|window| ((window.iter().sum::<i32>() - left_sum) / COUNT) as i16).collect();
    let mut costs = vec![0i16; count];
    for (a, b) in rows() {
        for (u, value) in a.iter().enumerate() {
            let value = i16::from(*value);
            for ((cost, other), offset) in costs.iter_mut().zip(&b[u..]).zip(&offsets) {
                *cost = cost.saturating_add((value + offset - i16::from(*other)).abs());
            }
        }
    }
    let best = (0..count).min_by_key(|at| costs[*at])?;
    let rival = costs.iter().enumerate().filter(|(at, _)| at.abs_diff(best) > CORNER).map(|(_, cost)| *cost).min();
    let is_clear = best > 0 && best + 1 < count && rival.is_none_or(|rival| f64::from(costs[best]) < UNIQUE * f64::from(rival));
    is_clear.then_some(first + best as i64)
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
        let keypoints = extractor.extract(&left).unwrap();
        let found = disparities(&keypoints, &left, &right, 60.0).unwrap();
        let mut errors: Vec<f64> = found.iter().flatten().map(|d| (d - 12.3).abs()).collect();
        errors.sort_by(f64::total_cmp);
        assert!(errors.len() > keypoints.len() / 3, "{} of {}", errors.len(), keypoints.len());
        assert!(errors[errors.len() / 2] < 0.05, "median error {}", errors[errors.len() / 2]);
        assert!(errors[errors.len() * 9 / 10] < 0.3, "90% below {}", errors[errors.len() * 9 / 10]);
    }

    #[test]
    fn where_a_pattern_repeats_no_disparity_is_taken() {
        let config = TrackingConfig::default();
        let extractor = Extractor::new(320, 240, 300, &config);
        // Squares every 20 pixels, of one grey above, of many below.
        let mut random = fastrand::Rng::with_seed(4);
        let greys: Vec<u8> = (0..17 * 12).map(|_| random.u8(60..)).collect();
        let square = |x: i32, y: i32| {
            let grey = if y < 120 { 200 } else { greys[(y / 20 * 17 + x / 20) as usize] };
            if x % 20 < 10 && y % 20 < 10 { grey } else { 20 }
        };
        let picture = |offset: i32| -> Vec<u8> { (0..320 * 240).map(|i| square(i % 320 + offset, i / 320)).collect() };
        let (left, right) = (extractor.pyramid(&picture(0)).unwrap(), extractor.pyramid(&picture(8)).unwrap());
        let keypoints = extractor.extract(&left).unwrap();
        let found = disparities(&keypoints, &left, &right, 100.0).unwrap();
        let share = |below: bool| {
            let own = || {
                keypoints
                    .iter()
                    .zip(&found)
                    .filter(|(k, _)| k.octave == 0 && (k.pixel.y > 130.0) == below && (k.pixel.y - 120.0).abs() > 10.0)
            };
            own().filter(|(_, d)| d.is_some()).count() as f64 / own().count() as f64
        };
        assert!(share(false) < 0.1 && share(true) > 0.5, "{} {}", share(false), share(true));
        let below: Vec<f64> = keypoints.iter().zip(&found).filter(|(k, _)| k.pixel.y > 130.0).filter_map(|(_, d)| *d).collect();
        let true_ones = below.iter().filter(|d| (**d - 8.0).abs() < 1.0).count();
        assert!(true_ones as f64 > 0.95 * below.len() as f64, "{true_ones} of {}", below.len());
    }
}
