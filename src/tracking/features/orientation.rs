//! The orientation of corners (Rublee et al., *ORB*, ICCV 2011, sec. 3.2): the direction to the intensity centroid of a round patch.

use pulp::{Arch, Simd};

use crate::tracking::features::orb::LevelImage;
use crate::tracking::features::quadtree::Corner;

/// Of the patch, pixels.
pub const PATCH_RADIUS: i32 = 15;
/// As wide as the patch and a column more, which makes whole vectors.
const COLUMNS: usize = 2 * PATCH_RADIUS as usize + 2;

/// The round patch.
#[derive(Clone, Debug)]
pub struct OrientationPatch {
    /// Rows `0..=PATCH_RADIUS` from the centre: all bits inside, 0 outside.
    masks: Vec<[i16; COLUMNS]>,
}

impl OrientationPatch {
    pub fn new() -> Self {
        let radius = f64::from(PATCH_RADIUS) + 0.5;
        let mask = |v: i32| {
            let half = (radius * radius - f64::from(v * v)).sqrt() as i32;
            std::array::from_fn(|k| if (k as i32 - PATCH_RADIUS).abs() <= half { -1 } else { 0 })
        };
        Self { masks: (0..=PATCH_RADIUS).map(mask).collect() }
    }

    /// Directions from corners to the centroids of their patches, radians in `[0, 2π)`. The patches and a column more lie in the image.
    pub fn angles(&self, image: &LevelImage<'_>, corners: &[Corner]) -> Vec<f32> {
        angles(self, image, corners)
    }

    /// First moments of a patch by column and by row. Sums of a column have 16 bits: 31 · 255 and (1 + … + 15) · 255 fit.
    #[inline(always)]
    fn moments(&self, image: &LevelImage<'_>, corner: &Corner) -> (i32, i32) {
        let row = |v: i32| -> &[u8; COLUMNS] {
            let first = (corner.y + v) as usize * image.width + (corner.x - PATCH_RADIUS) as usize;
            image.pixels[first..].first_chunk().expect("a patch inside the image")
        };
        let (mut sums, mut moments) = ([0i16; COLUMNS], [0i16; COLUMNS]);
        for (v, mask) in (0..).zip(&self.masks) {
            // The middle row counts once.
            let (above, below) = (row(-v), row(v));
            let once = if v == 0 { 0 } else { -1 };
            for k in 0..COLUMNS {
                let (above, below) = (i16::from(above[k]) & mask[k] & once, i16::from(below[k]) & mask[k]);
                sums[k] += above + below;
                moments[k] += v as i16 * (below - above);
            }
        }
        let (mut m10, mut m01) = (0, 0);
        for k in 0..COLUMNS {
            m10 += (k as i32 - PATCH_RADIUS) * i32::from(sums[k]);
            m01 += i32::from(moments[k]);
        }
        (m10, m01)
    }
}

#[pulp::with_simd(angles = Arch::new())]
#[inline(always)]
fn angles_with<'a, S: Simd>(_: S, patch: &'a OrientationPatch, image: &'a LevelImage<'a>, corners: &'a [Corner]) -> Vec<f32> {
    let mut angles = Vec::with_capacity(corners.len());
    for corner in corners {
        let (m10, m01) = patch.moments(image, corner);
        angles.push((m01 as f32).atan2(m10 as f32).rem_euclid(std::f32::consts::TAU));
    }
    angles
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_definition() {
        let mut random = fastrand::Rng::with_seed(8);
        let (width, height) = (64, 48);
        for brightest in [255, 20] {
            let pixels: Vec<u8> = (0..width * height).map(|_| random.u8(0..=brightest)).collect();
            let image = LevelImage { pixels: &pixels, width, height };
            let corners = [Corner { x: 16, y: 16, score: 0.0 }, Corner { x: 47, y: 31, score: 0.0 }];
            for (corner, angle) in corners.iter().zip(OrientationPatch::new().angles(&image, &corners)) {
                let (mut m10, mut m01) = (0.0, 0.0);
                for (u, v) in (-15..=15i32).flat_map(|v| (-15..=15i32).map(move |u| (u, v))).filter(|(u, v)| u * u + v * v <= 240)
                {
                    let value = f64::from(pixels[(corner.y + v) as usize * width + (corner.x + u) as usize]);
                    m10 += f64::from(u) * value;
                    m01 += f64::from(v) * value;
                }
                let expected = m01.atan2(m10).rem_euclid(std::f64::consts::TAU);
                assert!((f64::from(angle) - expected).abs() < 1e-5, "{angle} and {expected}");
            }
        }
    }

    #[test]
    fn the_brightest_patch_does_not_overflow() {
        // Bright below the middle: the largest moments there are.
        let (width, height) = (40, 40);
        let pixels: Vec<u8> = (0..width * height).map(|i| if i / width > 18 { 255 } else { 0 }).collect();
        let image = LevelImage { pixels: &pixels, width, height };
        let angle = OrientationPatch::new().angles(&image, &[Corner { x: 18, y: 18, score: 0.0 }])[0];
        assert!((angle - std::f32::consts::FRAC_PI_2).abs() < 1e-6, "{angle}");
    }
}
