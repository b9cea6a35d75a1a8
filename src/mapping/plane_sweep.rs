//! Depth of a keyframe whose camera measures none: a plane sweep over inverse depth (Collins, *A Space-Sweep Approach*, CVPR 1996) against
//! other views at known poses, census costs (Zabih & Woodfill 1994), semi-global aggregation (Hirschmüller, PAMI 2008).
//!
//! Landmarks bound the search and validate its result. A pixel whose best depth is not clearly the best, or that its
//! neighbours contradict, has none. Left out: slanted planes, and refinement of the poses.

mod aggregate;

use image::{GrayImage, RgbImage, imageops};
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::sequence::DepthImage;
use crate::splat::ViewCamera;

/// Depth where the recording has none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlaneSweepConfig {
    /// Whether depth is estimated at all.
    pub enabled: bool,
    /// Depths that are tried at each pixel.
    pub planes: usize,
    /// Other views that it is compared with, at most.
    pub views: usize,
    /// Least parallax of a view, pixels at the median depth of the landmarks.
    pub min_parallax_pixels: f64,
    /// The second best depth must cost this many times as much as the best one.
    pub uniqueness: f32,
    /// Least share of landmarks that the depth must agree with; below it all depth is dropped.
    pub min_agreement: f64,
    /// Weight of estimated depth in the loss, as a share of that of measured depth (`mapping.loss.depth_weight`).
    pub depth_confidence: f32,
}

impl Default for PlaneSweepConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            planes: 64,
            views: 3,
            min_parallax_pixels: 3.0,
            uniqueness: 1.04,
            min_agreement: 0.6,
            depth_confidence: 0.25,
        }
    }
}

impl PlaneSweepConfig {
    /// Checks every value.
    pub(super) fn validate(&self) -> Result<(), String> {
        if !(8..=256).contains(&self.planes) || !(1..=MOST_VIEWS).contains(&self.views) {
            return Err(format!("planes must lie between 8 and 256, and views between 1 and {MOST_VIEWS}"));
        }
        if !(self.uniqueness >= 1.0 && self.min_parallax_pixels >= 0.0 && (0.0..=1.0).contains(&self.min_agreement)) {
            return Err("uniqueness must be at least 1, min_parallax_pixels positive, min_agreement between 0 and 1".into());
        }
        if (0.0..=1.0).contains(&self.depth_confidence) {
            Ok(())
        } else {
            Err("depth_confidence must lie between 0 and 1".into())
        }
    }
}

/// Another view of the scene, of brightness alone.
#[derive(Clone, Copy, Debug)]
pub(super) struct SourceView<'a> {
    pub camera: ViewCamera,
    pub gray: &'a GrayImage,
}

/// A pixel's costs are held side by side, one a view.
const MOST_VIEWS: usize = 8;
/// Landmarks nearer to their estimate than this share of their depth are met.
const MET: f32 = 0.1;
/// Inverse depths that are searched reach beyond the landmarks' by these factors.
const BEYOND: [f64; 2] = [0.4, 1.4];
/// Landmarks whose depths the search leaves out at either end: outliers.
const OUTLIERS: f64 = 0.02;
const MIN_LANDMARKS: usize = 12;

/// Brightness at the size of a camera's image.
pub(super) fn gray(color: &RgbImage) -> GrayImage {
    imageops::grayscale(color)
}

/// Depth of a view from `landmarks` (its sparse depth) and the other views in order of preference; `None` where the views do not determine it.
pub(super) fn estimate(
    view: &SourceView<'_>,
    landmarks: &DepthImage,
    others: &[SourceView<'_>],
    config: &PlaneSweepConfig,
) -> Option<DepthImage> {
    let mut inverse: Vec<f64> = landmarks.metres.iter().filter(|m| **m > 0.0).map(|m| 1.0 / f64::from(*m)).collect();
    if inverse.len() < MIN_LANDMARKS {
        return None;
    }
    inverse.sort_by(f64::total_cmp);
    let quantile = |q: f64| inverse[(q * (inverse.len() - 1) as f64) as usize];
    let pinhole = &view.camera.pinhole;
    let parallax = |other: &&SourceView<'_>| {
        let other_from_view = other.camera.camera_from_world * view.camera.camera_from_world.inverse();
        other_from_view.translation.vector.norm() * quantile(0.5) * pinhole.fx >= config.min_parallax_pixels
    };
    let others: Vec<Source> = others.iter().filter(parallax).take(config.views).map(|other| Source::new(view, other)).collect();
    if others.is_empty() {
        return None;
    }
    let range = [BEYOND[0] * quantile(OUTLIERS), BEYOND[1] * quantile(1.0 - OUTLIERS)];
    let step = (range[1] - range[0]) / (config.planes - 1) as f64;
    let inverse_depths: Vec<f32> = (0..config.planes).map(|k| (range[0] + k as f64 * step) as f32).collect();
    let costs = matching_costs(view, &others, &inverse_depths);
    let sums = aggregate::aggregate(&costs, view.gray, config.planes);
    let best = best_planes(&sums, config);
    let supported = supported(&best, pinhole.width as usize);
    let metres: Vec<f32> =
        supported.into_iter().map(|plane| plane.map_or(0.0, |k| 1.0 / (range[0] as f32 + k * step as f32))).collect();
    let estimate = DepthImage { width: pinhole.width, height: pinhole.height, metres };
    (agreement(&estimate, landmarks) >= config.min_agreement).then_some(estimate)
}

/// Share of the landmarks at estimated pixels that the estimate meets.
fn agreement(estimate: &DepthImage, landmarks: &DepthImage) -> f64 {
    let (mut met, mut all) = (0, 0);
    for (estimated, landmark) in estimate.metres.iter().zip(&landmarks.metres).filter(|(e, l)| **e > 0.0 && **l > 0.0) {
        all += 1;
        met += usize::from((estimated - landmark).abs() < MET * landmark);
    }
    f64::from(met as u32) / f64::from(all.max(1) as u32)
}

/// Another view as the sweep meets it.
struct Source {
    census: Vec<u32>,
    size: [f32; 2],
    width: usize,
    /// Pixel of this view's ray, at inverse depth w: K·(R·ray + w·t), rows of K·R, and K·t.
    rotation: [Vector3<f32>; 3],
    translation: [f32; 3],
}

impl Source {
    fn new(view: &SourceView<'_>, other: &SourceView<'_>) -> Self {
        let p = &other.camera.pinhole;
        let other_from_view = other.camera.camera_from_world * view.camera.camera_from_world.inverse();
        let rotation = other_from_view.rotation.to_rotation_matrix();
        let rows = [0, 1, 2].map(|r| Vector3::new(rotation[(r, 0)], rotation[(r, 1)], rotation[(r, 2)]));
        let t = other_from_view.translation.vector;
        let projected = [rows[0] * p.fx + rows[2] * p.cx, rows[1] * p.fy + rows[2] * p.cy, rows[2]];
        Self {
            census: census(other.gray),
            size: [p.width as f32, p.height as f32],
            width: p.width as usize,
            rotation: projected.map(|row| row.map(|v| v as f32)),
            translation: [p.fx * t.x + p.cx * t.z, p.fy * t.y + p.cy * t.z, t.z].map(|v| v as f32),
        }
    }

    /// The census code where a ray (of which `turned` is the projected direction) is met at an inverse depth.
    fn at(&self, turned: [f32; 3], inverse_depth: f32) -> Option<u32> {
        let [x, y, z] = std::array::from_fn(|k| turned[k] + inverse_depth * self.translation[k]);
        let (x, y) = (x / z + 0.5, y / z + 0.5);
        // NaN fails.
        let inside = z > 0.0 && x >= 0.0 && y >= 0.0 && x < self.size[0] && y < self.size[1];
        inside.then(|| self.census[y as usize * self.width + x as usize])
    }
}

/// Bits in which two census codes can differ.
const CENSUS_BITS: u8 = 24;
const CENSUS_REACH: i32 = 2;

/// Census transform over 5×5 pixels: one bit for each darker neighbour.
fn census(gray: &GrayImage) -> Vec<u32> {
    let (width, height) = (gray.width() as i32, gray.height() as i32);
    let at = |x: i32, y: i32| gray.as_raw()[(y.clamp(0, height - 1) * width + x.clamp(0, width - 1)) as usize];
    let code = |x: i32, y: i32| {
        let around = (-CENSUS_REACH..=CENSUS_REACH).flat_map(|dy| (-CENSUS_REACH..=CENSUS_REACH).map(move |dx| (dx, dy)));
        let own = at(x, y);
        around.filter(|offset| *offset != (0, 0)).fold(0, |code, (dx, dy)| code << 1 | u32::from(at(x + dx, y + dy) < own))
    };
    (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| code(x, y)).collect()
}

/// `[H, W, planes]`: in how many bits the codes differ; mean over the better half of the views that see the place.
fn matching_costs(view: &SourceView<'_>, others: &[Source], inverse_depths: &[f32]) -> Vec<u8> {
    let pinhole = &view.camera.pinhole;
    let (width, planes) = (pinhole.width as usize, inverse_depths.len());
    let own = census(view.gray);
    let mut costs = vec![CENSUS_BITS / 2; own.len() * planes];
    costs.par_chunks_exact_mut(width * planes).enumerate().for_each(|(y, row)| {
        for (x, costs) in row.chunks_exact_mut(planes).enumerate() {
            let ray = pinhole.unproject(&Vector2::new(x as f64, y as f64), 1.0).map(|v| v as f32);
            let code = own[y * width + x];
            let turned: Vec<[f32; 3]> = others.iter().map(|source| source.rotation.map(|row| row.dot(&ray))).collect();
            for (cost, inverse_depth) in costs.iter_mut().zip(inverse_depths) {
                let mut seen = [u8::MAX; MOST_VIEWS];
                let mut count = 0;
                for (source, turned) in others.iter().zip(&turned) {
                    if let Some(other) = source.at(*turned, *inverse_depth) {
                        seen[count] = (code ^ other).count_ones() as u8;
                        count += 1;
                    }
                }
                if count > 0 {
                    seen[..count].sort_unstable();
                    let half = count.div_ceil(2);
                    *cost = (seen[..half].iter().map(|c| u32::from(*c)).sum::<u32>() / half as u32) as u8;
                }
            }
        }
    });
    costs
}

/// Best plane of each pixel, interpolated; none where another one is nearly as good.
fn best_planes(sums: &[u16], config: &PlaneSweepConfig) -> Vec<Option<f32>> {
    let best = |sums: &[u16]| {
        let (k, least) = (0..).zip(sums).min_by_key(|(_, sum)| **sum)?;
        let k: usize = k;
        let apart = |other: usize| other.abs_diff(k) > 1;
        let second = (0..).zip(sums).filter(|(other, _)| apart(*other)).map(|(_, sum)| *sum).min()?;
        let at_the_end = k == 0 || k + 1 == sums.len();
        if at_the_end || f32::from(second) < config.uniqueness * f32::from(*least) {
            return None;
        }
        // Where the parabola through the three least has its minimum.
        let [before, here, after] = [sums[k - 1], sums[k], sums[k + 1]].map(f32::from);
        let curvature = before - 2.0 * here + after;
        Some(k as f32 + if curvature > 0.0 { 0.5 * (before - after) / curvature } else { 0.0 })
    };
    sums.par_chunks_exact(config.planes).map(best).collect()
}

/// Planes that most of the pixels around agree with.
fn supported(best: &[Option<f32>], width: usize) -> Vec<Option<f32>> {
    let height = best.len() / width;
    let supported = |i: usize| {
        let (x, y) = (i % width, i / width);
        let own = best[i]?;
        let around = (y.saturating_sub(1)..(y + 2).min(height))
            .flat_map(|v| (x.saturating_sub(1)..(x + 2).min(width)).map(move |u| v * width + u));
        let agree = around.filter(|&j| best[j].is_some_and(|other| (other - own).abs() < 1.0)).count();
        // The pixel itself is among them.
        (agree >= 6).then_some(own)
    };
    (0..best.len()).into_par_iter().map(supported).collect()
}

#[cfg(test)]
mod tests;
