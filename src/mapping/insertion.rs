//! New Gaussians from a keyframe: where the render lacks alpha, lies behind the measured surface or misses detail, one per block of pixels:
//! a quadtree of blocks, small where the colours vary and large where they don't, each Gaussian the size of its block on the surface.
//!
//! Pixels that the camera did not record get none.
//!
//! Pixels without depth get Gaussians too where the map has nothing: their depth is interpolated across the hole, from the farther side
//! where the sides differ (a structured-light sensor is blind in the shadow beside a near object). Later views correct them.

use glam::{Quat, Vec3};
use image::RgbImage;
use nalgebra::{Point3, Rotation3, UnitQuaternion, Vector2, Vector3};

use super::{InsertionConfig, Keyframe};
use crate::render::Rendered;
use crate::sequence::DepthImage;
use crate::splat::{Gaussian, GaussianCloud, ShDegree, raw_opacity_from_opacity, sh::dc_from_color};

/// Sides of a hole whose depths differ by more than this factor belong to different surfaces.
const SAME_SURFACE_RATIO: f32 = 1.2;

/// Discs seen more obliquely than this are drawn no longer.
const MIN_COSINE: f64 = 0.35;

/// Gaussians for what `keyframe` shows and `rendered`, the map seen from it, lacks. Without a render they cover the whole image.
pub(super) fn gaussians(
    keyframe: &Keyframe,
    rendered: Option<&Rendered>,
    config: &InsertionConfig,
    sh_degree: ShDegree,
) -> GaussianCloud {
    let mut cloud = GaussianCloud::new(sh_degree);
    let image = &keyframe.image;
    let Some(depth) = &image.depth else { return cloud };
    let (width, height) = image.color.dimensions();
    let blocks = || ColorSums::new(&image.color).blocks(config);
    let missed = || rendered.map(|r| Missed::new(&image.color, r));
    let (filled, (blocks, missed)) = rayon::join(|| fill_holes(depth), || rayon::join(blocks, missed));
    for block in blocks {
        let center = ((block.x + block.size / 2).min(width - 1), (block.y + block.size / 2).min(height - 1));
        let pixel = (center.1 * width + center.0) as usize;
        let metres = filled[pixel];
        let measured = depth.at(center.0, center.1);
        if image.is_valid(pixel)
            && metres >= config.min_depth_metres
            && metres <= config.max_depth_metres
            && (rendered.is_none_or(|r| lacks(r, pixel, measured, config))
                || missed.as_ref().is_some_and(|m| m.response(block) > config.missed_detail))
        {
            let slope = slope(&filled, (width, height), center, block.size);
            cloud.push(gaussian(keyframe, &SurfacePoint { x: center.0, y: center.1, metres, slope }, block.size, config));
        }
    }
    cloud
}

/// Whether the map lacks what the pixel shows.
fn lacks(rendered: &Rendered, pixel: usize, measured: Option<f32>, config: &InsertionConfig) -> bool {
    let nearer = |m: f32| rendered.expected_depth(pixel) - m > config.depth_disagreement * m;
    rendered.alpha(pixel) < config.min_alpha || measured.is_some_and(nearer)
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
fn gaussian(keyframe: &Keyframe, point: &SurfacePoint, stride: u32, config: &InsertionConfig) -> Gaussian {
    let SurfacePoint { x, y, metres, slope } = *point;
    let pinhole = &keyframe.image.pinhole;
    let ray = pinhole.unproject(&Vector2::new(f64::from(x), f64::from(y)), 1.0);
    let p_in_world = keyframe.world_from_camera * Point3::from(ray * f64::from(metres));
    let spacing_metres = stride as f32 * metres / pinhole.fx as f32;
    let color = keyframe.image.color.get_pixel(x, y).0.map(|c| f32::from(c) / 255.0);
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
        sh: vec![dc_from_color(Vec3::from(color))],
    }
}

/// A square of pixels that gets one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Block {
    x: u32,
    y: u32,
    size: u32,
}

/// Sums of `N` values over the pixels above and left of each corner, `[H + 1, W + 1]`, so that those over any rectangle cost four reads.
struct Sums<T, const N: usize> {
    width: u32,
    height: u32,
    sums: Vec<[T; N]>,
}

impl<T: Copy + Default, const N: usize> Sums<T, N> {
    /// Sums of values in row-major order.
    fn new((width, height): (u32, u32), mut values: impl Iterator<Item = [T; N]>, add: impl Fn(T, T) -> T) -> Self {
        let row = width as usize + 1;
        let mut sums = vec![[T::default(); N]; row * (height as usize + 1)];
        for y in 1..=height as usize {
            let (above, below) = sums.split_at_mut(y * row);
            let above = &above[(y - 1) * row + 1..];
            let mut along = [T::default(); N];
            for ((to, above), own) in below[1..row].iter_mut().zip(above).zip(&mut values) {
                along = std::array::from_fn(|k| add(along[k], own[k]));
                *to = std::array::from_fn(|k| add(above[k], along[k]));
            }
        }
        Self { width, height, sums }
    }

    /// The sums at the corners of a rectangle, from its first corner to before its last, as far as it is on the image: top left, top right,
    /// bottom left, bottom right; and its pixels.
    fn corners(&self, (x0, y0): (u32, u32), (x1, y1): (u32, u32)) -> ([[T; N]; 4], f64) {
        let (x1, y1) = (x1.min(self.width), y1.min(self.height));
        let at = |x: u32, y: u32| self.sums[y as usize * (self.width as usize + 1) + x as usize];
        ([at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1)], f64::from((x1 - x0) * (y1 - y0)))
    }
}

/// The channels of an image, and the squares of all three together (8-bit values). They wrap, but not their differences over a block.
struct ColorSums(Sums<u32, 4>);

impl ColorSums {
    fn new(image: &RgbImage) -> Self {
        let values = image.as_raw().chunks_exact(3).map(|pixel| {
            let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
            [r, g, b, r * r + g * g + b * b]
        });
        Self(Sums::new(image.dimensions(), values, u32::wrapping_add))
    }

    /// Blocks that cover the image: quartered while their colours deviate more than noise does, but not below the stride.
    fn blocks(&self, config: &InsertionConfig) -> Vec<Block> {
        let size = config.flat_stride;
        let corners =
            (0..self.0.height).step_by(size as usize).flat_map(|y| (0..self.0.width).step_by(size as usize).map(move |x| (x, y)));
        let mut blocks = Vec::new();
        let mut open: Vec<Block> = corners.map(|(x, y)| Block { x, y, size }).collect();
        while let Some(block) = open.pop() {
            if block.size >= 2 * config.stride && self.deviation(block) > config.detail {
                let half = block.size / 2;
                let quarters = [(0, 0), (half, 0), (0, half), (half, half)].map(|(dx, dy)| (block.x + dx, block.y + dy));
                let inside = quarters.into_iter().filter(|(x, y)| *x < self.0.width && *y < self.0.height);
                open.extend(inside.map(|(x, y)| Block { x, y, size: half }));
            } else {
                blocks.push(block);
            }
        }
        blocks
    }

    /// Standard deviation of the colours about their mean over the part of a block that is on the image, 0 to 1, mean over the channels.
    fn deviation(&self, Block { x, y, size }: Block) -> f32 {
        let ([above, beside, below, last], pixels) = self.0.corners((x, y), (x + size, y + size));
        let sum = |k: usize| last[k].wrapping_add(above[k]).wrapping_sub(beside[k]).wrapping_sub(below[k]);
        let [r, g, b, squares] = std::array::from_fn(|k| f64::from(sum(k)) / pixels);
        let variance = (squares - (r * r + g * g + b * b)) / 3.0;
        variance.max(0.0).sqrt() as f32 / 255.0
    }
}

/// Brightness residual, image minus render.
struct Missed(Sums<f64, 1>);

impl Missed {
    fn new(image: &RgbImage, rendered: &Rendered) -> Self {
        let missed = |(pixel, render): (&[u8], &[f32; 4])| {
            [(0..3).map(|k| f64::from(pixel[k]) / 255.0 - f64::from(render[k])).sum::<f64>() / 3.0]
        };
        let values = image.as_raw().chunks_exact(3).zip(&rendered.color_depth).map(missed);
        Self(Sums::new(image.dimensions(), values, |a, b| a + b))
    }

    /// How a block differs from its surroundings in what is missed: the Laplacian of Gaussian at the block's scale, by boxes.
    fn response(&self, Block { x, y, size }: Block) -> f32 {
        let mean = |first, end| {
            let ([[above], [beside], [below], [last]], pixels) = self.0.corners(first, end);
            (last + above - beside - below) / pixels
        };
        let around = mean((x.saturating_sub(size), y.saturating_sub(size)), (x + 2 * size, y + 2 * size));
        (mean((x, y), (x + size, y + size)) - around).abs() as f32
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
    use super::super::DepthSource;
    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::sequence::RectifiedImage;
    use image::Rgb;

    fn keyframe(color: RgbImage, metres: Vec<f32>) -> Keyframe {
        let (width, height) = color.dimensions();
        let pinhole = Pinhole { fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5, width, height };
        let image = RectifiedImage { pinhole, color, depth: Some(DepthImage { width, height, metres }), valid: None };
        Keyframe { id: 0, world_from_camera: Se3::identity(), image, depth_source: DepthSource::Sensor, covisible: vec![] }
    }

    #[test]
    fn detail_gets_more_gaussians_than_a_flat_wall() {
        let config = InsertionConfig { stride: 2, flat_stride: 8, ..InsertionConfig::default() };
        let checker = RgbImage::from_fn(32, 24, |x, y| if x < 16 { Rgb([90; 3]) } else { Rgb([((x + y) % 2 * 255) as u8; 3]) });
        let cloud = gaussians(&keyframe(checker, vec![1.0; 32 * 24]), None, &config, ShDegree::default());
        let column = |m: &Vec3| m.x * 30.0 + 15.5;
        assert_eq!(cloud.means.iter().filter(|m| column(m) < 15.9).count(), 2 * 3);
        assert_eq!(cloud.means.iter().filter(|m| column(m) > 16.1).count(), 8 * 12);
    }

    #[test]
    fn blocks_cover_each_pixel_once_and_shrink_towards_an_edge() {
        let config = InsertionConfig { stride: 1, flat_stride: 8, ..InsertionConfig::default() };
        let edge = RgbImage::from_fn(45, 27, |x, y| if x < 19 { Rgb([40; 3]) } else { Rgb([200 + (y % 2) as u8; 3]) });
        let blocks = ColorSums::new(&edge).blocks(&config);
        let mut covered = vec![0; 45 * 27];
        for block in &blocks {
            for (x, y) in (block.y..block.y + block.size).flat_map(|y| (block.x..block.x + block.size).map(move |x| (x, y))) {
                if x < 45 && y < 27 {
                    covered[(y * 45 + x) as usize] += 1;
                }
            }
        }
        assert!(covered.iter().all(|&times| times == 1));
        let largest_at = |column: u32| blocks.iter().filter(|b| (b.x..b.x + b.size).contains(&column)).map(|b| b.size).max();
        assert_eq!([largest_at(18), largest_at(19), largest_at(30)], [Some(1), Some(1), Some(8)]);
    }

    #[test]
    fn only_what_the_map_lacks_is_inserted() {
        let config = InsertionConfig { flat_stride: 2, ..InsertionConfig::default() };
        let frame = keyframe(RgbImage::from_pixel(32, 24, Rgb([90; 3])), vec![1.0; 32 * 24]);
        let render = |x: usize| match x / 8 {
            0 => ([0.0, 0.0, 0.0, 1.0], 0.0), // as measured
            1 => ([0.0, 0.0, 0.0, 0.0], 1.0), // nothing there
            2 => ([0.0, 0.0, 0.0, 1.5], 0.0), // the map is behind
            _ => ([0.0, 0.0, 0.0, 0.7], 0.0), // the map is in front
        };
        let pixels: Vec<_> = (0..32 * 24).map(|i| render(i % 32)).collect();
        let rendered = Rendered {
            width: 32,
            height: 24,
            color_depth: pixels.iter().map(|p| p.0).collect(),
            transmittance: pixels.iter().map(|p| p.1).collect(),
        };
        let cloud = gaussians(&frame, Some(&rendered), &config, ShDegree::default());
        assert_eq!(cloud.len(), 2 * 4 * 12);
        assert!(cloud.means.iter().all(|m| (7.0..=24.5).contains(&(m.x * 30.0 + 15.5))));
    }

    #[test]
    fn a_spot_that_the_render_lacks_is_missed_detail_and_another_brightness_is_not() {
        let spot = |x: u32, y: u32| (8..10).contains(&x) && (12..14).contains(&y);
        let image = RgbImage::from_fn(32, 24, |x, y| Rgb([if spot(x, y) { 200 } else { 90 }; 3]));
        let rendered = Rendered {
            width: 32,
            height: 24,
            color_depth: vec![[0.2, 0.2, 0.2, 1.0]; 32 * 24],
            transmittance: vec![0.0; 32 * 24],
        };
        let missed = Missed::new(&image, &rendered);
        let response = |x, y| missed.response(Block { x, y, size: 2 });
        assert!(response(8, 12) > 0.3, "{}", response(8, 12));
        assert!([(0, 0), (20, 12), (30, 22)].into_iter().all(|(x, y)| response(x, y) < 1e-3));
        let frame = keyframe(image, vec![1.0; 32 * 24]);
        let config = InsertionConfig { missed_detail: 0.1, ..InsertionConfig::default() };
        let cloud = gaussians(&frame, Some(&rendered), &config, ShDegree::default());
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
