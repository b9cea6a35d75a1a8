//! New Gaussians from a keyframe: where the render lacks alpha, lies behind the measured surface or misses detail, one per block of pixels:
//! a quadtree of blocks, small where the colours vary and large where they don't, each Gaussian the size of its block on the surface.
//!
//! Pixels that the camera did not record get none.
//!
//! Pixels without depth get Gaussians too where the map has nothing: their depth is interpolated across the hole, from the farther side
//! where the sides differ (a structured-light sensor is blind in the shadow beside a near object). Later views correct them.

mod blocks;

use glam::{Quat, Vec3};
use nalgebra::{Point3, Rotation3, UnitQuaternion, Vector2, Vector3};
use rayon::iter::{IndexedParallelIterator, IntoParallelRefIterator, ParallelIterator};

use self::blocks::{Block, ColorSums, Missed};
use super::{InsertionConfig, Keyframe};
use crate::optimise::{Survey, SurveyedCell};
use crate::sequence::{DepthImage, RectifiedImage};
use crate::splat::{Exposure, Gaussian, GaussianCloud, ShDegree, raw_opacity_from_opacity, sh::dc_from_color};

/// Sides of a hole whose depths differ by more than this factor belong to different surfaces.
const SAME_SURFACE_RATIO: f32 = 1.2;

/// Fewer blocks are not worth a task of the thread pool.
const BLOCKS_A_TASK: usize = 1 << 10;

/// Discs seen more obliquely than this are drawn no longer.
const MIN_COSINE: f64 = 0.35;

/// Insertion candidates of a keyframe, before the comparison with the map.
pub(super) struct Candidates {
    blocks: Vec<Block>,
    sums: ColorSums,
    /// Depth without holes, `[H, W]` metres.
    filled: Vec<f32>,
}

impl Candidates {
    /// Those of an image with depth; `None` without.
    pub fn new(image: &RectifiedImage, config: &InsertionConfig) -> Option<Self> {
        let depth = image.depth.as_ref()?;
        let of_colors = || {
            let sums = ColorSums::new(&image.color);
            (sums.blocks(config), sums)
        };
        let (filled, (blocks, sums)) = rayon::join(|| fill_holes(depth), of_colors);
        Some(Self { blocks, sums, filled })
    }
}

/// New Gaussians: the candidates that the map lacks. `shown` has the survey of the map from the keyframe, and the keyframe's exposure. Without a
/// survey all candidates are new.
pub(super) fn gaussians(
    keyframe: &Keyframe,
    candidates: &Candidates,
    shown: (Option<&Survey>, &Exposure),
    config: &InsertionConfig,
    sh_degree: ShDegree,
) -> GaussianCloud {
    let (survey, exposure) = shown;
    let (image, Candidates { blocks, sums, filled }) = (&keyframe.image, candidates);
    let (width, height) = image.color.dimensions();
    let missed = survey.map(|survey| Missed::new(sums, survey, exposure, config.stride));
    let lacking = |block: Block, center: (u32, u32)| {
        survey.is_none_or(|survey| lacks(survey, block, center, config.stride))
            || missed.as_ref().is_some_and(|missed| missed.response(block) > config.missed_detail)
    };
    let new = |&block: &Block| {
        let center = block.center(config.stride, (width, height));
        let pixel = (center.1 * width + center.0) as usize;
        let metres = filled[pixel];
        let in_range = metres >= config.min_depth_metres && metres <= config.max_depth_metres;
        (image.is_valid(pixel) && in_range && lacking(block, center)).then(|| {
            let slope = slope(filled, (width, height), center, block.size);
            let point = SurfacePoint { x: center.0, y: center.1, metres, slope };
            gaussian(keyframe, &point, block.size, exposure, config)
        })
    };
    let new: Vec<Gaussian> = blocks.par_iter().with_min_len(BLOCKS_A_TASK).filter_map(new).collect();
    let mut cloud = GaussianCloud::new(sh_degree);
    new.into_iter().for_each(|gaussian| cloud.push(gaussian));
    cloud
}

/// Whether the map lacks what the pixel at the center of a block shows.
fn lacks(survey: &Survey, block: Block, (x, y): (u32, u32), cell: u32) -> bool {
    let SurveyedCell { lacks_corner, lacks_center, .. } = survey.cell((y / cell * survey.columns + x / cell) as usize);
    if block.size == cell { lacks_center } else { lacks_corner }
}

/// ∂depth/∂(x, y) around a pixel relative to the depth, 1/pixels; none across an edge.
fn slope(filled: &[f32], (width, height): (u32, u32), (x, y): (u32, u32), stride: u32) -> [f32; 2] {
    let at = |x: u32, y: u32| filled[(y * width + x) as usize];
    let along = |low: f32, here: f32, high: f32, span: u32| {
        let smooth = low > 0.0 && high > 0.0 && low.max(here).max(high) < SAME_SURFACE_RATIO * low.min(here).min(high);
        if smooth && span > 0 { (high - low) / (here * span as f32) } else { 0.0 }
    };
    let reach = stride.max(2);
    let (left, right) = (x.saturating_sub(reach), (x + reach).min(width - 1));
    let (top, bottom) = (y.saturating_sub(reach), (y + reach).min(height - 1));
    [along(at(left, y), at(x, y), at(right, y), right - left), along(at(x, top), at(x, y), at(x, bottom), bottom - top)]
}

/// The surface at a pixel.
struct SurfacePoint {
    x: u32,
    y: u32,
    /// Depth along z.
    metres: f32,
    /// ∂depth/∂(x, y) relative to the depth, 1/pixels.
    slope: [f32; 2],
}

/// A disc on the surface, as large as its block of pixels there.
fn gaussian(keyframe: &Keyframe, point: &SurfacePoint, stride: u32, exposure: &Exposure, config: &InsertionConfig) -> Gaussian {
    let SurfacePoint { x, y, metres, slope } = *point;
    let pinhole = &keyframe.image.pinhole;
    let ray = pinhole.unproject(&Vector2::new(f64::from(x), f64::from(y)), 1.0);
    let p_in_world = keyframe.world_from_camera * Point3::from(ray * f64::from(metres));
    let spacing_metres = stride as f32 * metres / pinhole.fx as f32;
    let recorded = Vec3::from(keyframe.image.color.get_pixel(x, y).0.map(|c| f32::from(c) / 255.0));
    let color = (recorded / exposure.gains()).min(Vec3::ONE);
    // The surface's tangents along x and y of the image, per pixel at depth 1: ∂(z·ray)/∂x.
    let tangent = |k: usize, focal: f64| {
        let mut along = Vector3::zeros();
        along[k] = 1.0 / focal;
        along + ray * f64::from(slope[k])
    };
    let normal = tangent(0, pinhole.fx).cross(&tangent(1, pinhole.fy)).normalize();
    let cosine = (normal.dot(&ray) / ray.norm()).abs().max(MIN_COSINE);
    // The tilt's direction, in which the block is longer on the surface; any direction across where there is no tilt.
    let across = normal.cross(&ray).try_normalize(1e-6).unwrap_or_else(|| normal.cross(&Vector3::y()).normalize());
    let tilt = normal.cross(&across);
    let axes = Rotation3::from_basis_unchecked(&[across, tilt, normal]);
    let world_from_disc =
        (keyframe.world_from_camera.rotation * UnitQuaternion::from_rotation_matrix(&axes)).coords.map(|v| v as f32);
    let [qx, qy, qz, qw] = world_from_disc.into();
    let size = config.footprint * spacing_metres;
    let scale = Vec3::new(size, size / cosine as f32, size * config.thickness);
    Gaussian {
        mean: Vec3::new(p_in_world.x as f32, p_in_world.y as f32, p_in_world.z as f32),
        log_scale: Vec3::new(scale.x.ln(), scale.y.ln(), scale.z.ln()),
        rotation: Quat::from_xyzw(qx, qy, qz, qw),
        raw_opacity: raw_opacity_from_opacity(config.opacity),
        sh: vec![dc_from_color(color)],
    }
}

/// Depth with its holes interpolated from their four sides, metres; 0 only where a pixel has no measured side at all.
fn fill_holes(depth: &DepthImage) -> Vec<f32> {
    let width = depth.width as usize;
    let mut filled = depth.metres.clone();
    let holes: Vec<usize> = (0..filled.len()).filter(|&i| depth.metres[i] <= 0.0).collect();
    // Nearest measured pixel of each hole to the left, right, top and bottom: (depth, distance).
    let mut sides = vec![[(0.0f32, 0.0f32); 4]; holes.len()];
    let mut sweep = |side: usize,
                     order: &mut dyn Iterator<Item = usize>,
                     line: &dyn Fn(usize) -> usize,
                     towards: &dyn Fn(usize) -> Option<usize>| {
        // Of the last hole in each row or column.
        let mut last = vec![(0.0f32, 0.0f32); width.max(depth.height as usize)];
        for hole in order {
            let i = holes[hole];
            let Some(neighbour) = towards(i) else { continue };
            let (metres, distance) = if depth.metres[neighbour] > 0.0 { (depth.metres[neighbour], 0.0) } else { last[line(i)] };
            sides[hole][side] = (metres, distance + 1.0);
            last[line(i)] = sides[hole][side];
        }
    };
    let (row, column) = (|i: usize| i / width, |i: usize| i % width);
    sweep(0, &mut (0..holes.len()), &row, &|i| (column(i) > 0).then(|| i - 1));
    sweep(1, &mut (0..holes.len()).rev(), &row, &|i| (column(i) + 1 < width).then_some(i + 1));
    sweep(2, &mut (0..holes.len()), &column, &|i| i.checked_sub(width));
    sweep(3, &mut (0..holes.len()).rev(), &column, &|i| (i + width < depth.metres.len()).then_some(i + width));
    holes.iter().zip(&sides).for_each(|(&i, around)| filled[i] = interpolate(around));
    filled
}

fn interpolate(around: &[(f32, f32); 4]) -> f32 {
    let known = || around.iter().filter(|(metres, _)| *metres > 0.0);
    let farthest = known().map(|s| s.0).fold(0.0, f32::max);
    let (mut sum, mut weights) = (0.0, 0.0);
    for (metres, distance) in known().filter(|s| s.0 * SAME_SURFACE_RATIO >= farthest) {
        sum += metres / distance;
        weights += 1.0 / distance;
    }
    if weights > 0.0 { sum / weights } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::sequence::RectifiedImage;
    use image::{Rgb, RgbImage};

    fn keyframe(color: RgbImage, metres: Vec<f32>) -> Keyframe {
        let (width, height) = color.dimensions();
        let pinhole = Pinhole { fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5, width, height };
        let image = RectifiedImage { pinhole, color, depth: Some(DepthImage { width, height, metres }), valid: None };
        Keyframe::new(0, Se3::identity(), image)
    }

    #[test]
    fn detail_gets_more_gaussians_than_a_flat_wall() {
        let config = InsertionConfig { stride: 2, flat_stride: 8, ..InsertionConfig::default() };
        let checker = RgbImage::from_fn(32, 24, |x, y| if x < 16 { Rgb([90; 3]) } else { Rgb([((x + y) % 2 * 255) as u8; 3]) });
        let cloud = inserted(&keyframe(checker, vec![1.0; 32 * 24]), None, &config);
        let column = |m: &Vec3| m.x * 30.0 + 15.5;
        assert_eq!(cloud.means.iter().filter(|m| column(m) < 15.9).count(), 2 * 3);
        assert_eq!(cloud.means.iter().filter(|m| column(m) > 16.1).count(), 8 * 12);
    }

    fn inserted(frame: &Keyframe, survey: Option<&Survey>, config: &InsertionConfig) -> GaussianCloud {
        let candidates = Candidates::new(&frame.image, config).unwrap();
        gaussians(frame, &candidates, (survey, &Exposure::default()), config, ShDegree::default())
    }

    /// Cells of two pixels over an image of 32×24.
    fn survey(cell: impl Fn(u32) -> SurveyedCell) -> Survey {
        Survey::of_cells(16, &(0..16 * 12).map(|i| cell(2 * (i % 16))).collect::<Vec<_>>())
    }

    #[test]
    fn only_what_the_map_lacks_is_inserted() {
        let config = InsertionConfig { flat_stride: 2, ..InsertionConfig::default() };
        let frame = keyframe(RgbImage::from_pixel(32, 24, Rgb([90; 3])), vec![1.0; 32 * 24]);
        let brightness = 90.0 / 255.0;
        let cell = |x: u32| SurveyedCell { brightness, lacks_center: (8..24).contains(&x), lacks_corner: false };
        let cloud = inserted(&frame, Some(&survey(cell)), &config);
        assert_eq!(cloud.len(), 2 * 4 * 12);
        assert!(cloud.means.iter().all(|m| (7.0..=24.5).contains(&(m.x * 30.0 + 15.5))));
        // Larger blocks ask for the pixel in their middle, the first one of a cell.
        let config = InsertionConfig { flat_stride: 4, ..config };
        let cell = |x: u32| SurveyedCell { brightness, lacks_corner: x == 10, lacks_center: x != 10 };
        let cloud = inserted(&frame, Some(&survey(cell)), &config);
        assert!(cloud.len() == 6 && cloud.means.iter().all(|m| (m.x * 30.0 + 15.5 - 10.0).abs() < 1e-4));
    }

    #[test]
    fn colors_are_those_of_the_maps_exposure() {
        let frame = keyframe(RgbImage::from_pixel(32, 24, Rgb([90, 90, 255])), vec![1.0; 32 * 24]);
        let config = InsertionConfig::default();
        let candidates = Candidates::new(&frame.image, &config).unwrap();
        let exposure = Exposure([1.2f32.ln(), 0.0, 0.9f32.ln()]);
        let cloud = gaussians(&frame, &candidates, (None, &exposure), &config, ShDegree::ALL[0]);
        let expected = dc_from_color(Vec3::new(75.0 / 255.0, 90.0 / 255.0, 1.0));
        assert!(cloud.sh.iter().all(|sh| (*sh - expected).length() < 1e-5));
    }

    #[test]
    fn a_spot_that_the_render_lacks_is_missed_detail_and_another_brightness_is_not() {
        let spot = |x: u32, y: u32| (8..10).contains(&x) && (12..14).contains(&y);
        let image = RgbImage::from_fn(32, 24, |x, y| Rgb([if spot(x, y) { 200 } else { 90 }; 3]));
        let frame = keyframe(image, vec![1.0; 32 * 24]);
        let config = InsertionConfig { missed_detail: 0.1, ..InsertionConfig::default() };
        let shown = survey(|_| SurveyedCell { brightness: 0.2, ..SurveyedCell::default() });
        let cloud = inserted(&frame, Some(&shown), &config);
        let columns: Vec<f32> = cloud.means.iter().map(|m| m.x * 30.0 + 15.5).collect();
        assert!(!columns.is_empty() && columns.iter().all(|c| (6.0..13.0).contains(c)), "{columns:?}");
    }

    #[test]
    fn holes_take_the_farther_side_and_interpolate_a_slope() {
        let mut metres = vec![0.0; 9];
        (metres[0], metres[8]) = (1.0, 3.0);
        let filled = fill_holes(&DepthImage { width: 9, height: 1, metres });
        assert!(filled[1..8].iter().all(|m| *m == 3.0));
        let filled = fill_holes(&DepthImage { width: 5, height: 1, metres: vec![1.0, 0.0, 0.0, 0.0, 1.1] });
        assert!((filled[2] - 1.05).abs() < 1e-6 && filled[1] < filled[2] && filled[2] < filled[3]);
        assert!(fill_holes(&DepthImage { width: 2, height: 1, metres: vec![0.0; 2] }).iter().all(|m| *m == 0.0));
    }
}
