//! Which Gaussians a camera sees, and where in its image: a rendering of blocks of pixels on the CPU.
//!
//! Neither a GPU nor the whole map's place on one is needed. Each Gaussian is taken as round, with the geometric mean of its two longer axes.

use glam::Vec3;

use crate::geometry::Pinhole;
use crate::splat::model::NEAR_METRES;
use crate::splat::{GaussianCloud, ViewCamera, opacity_from_raw};

/// Side of a block, pixels.
pub const BLOCK: u32 = 8;
/// A block is finished once less light than this passes.
const LEAST_TRANSMITTANCE: f32 = 1e-2;
/// Alphas below this are passed over.
const LEAST_ALPHA: f32 = 1e-3;
/// Variance of a block of side 1 as a Gaussian of the same integral and peak.
const BLOCK_VARIANCE: f32 = 1.0 / std::f32::consts::TAU;
/// Standard deviations after which a Gaussian ends.
const EXTENT: f32 = 3.0;

/// What a camera sees of a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Coverage {
    /// Blocks in a row.
    pub columns: u32,
    /// Rows of blocks.
    pub rows: u32,
    /// Block, row-major, Gaussian, and its share of the block's light, 0 to 1; front to back in each block.
    pub shares: Vec<(u32, u32, f32)>,
}

/// A Gaussian in the image, in blocks.
struct Seen {
    gaussian: u32,
    depth: f32,
    x: f32,
    y: f32,
    variance: f32,
    opacity: f32,
}

impl Coverage {
    /// Renders a map in blocks.
    pub fn of(cloud: &GaussianCloud, camera: &ViewCamera) -> Self {
        let [columns, rows] = size(&camera.pinhole);
        let mut coverage = Self { columns, rows, shares: Vec::new() };
        let mut transmittance = vec![1.0f32; (columns * rows) as usize];
        for seen in seen(cloud, camera) {
            let variance = seen.variance + BLOCK_VARIANCE;
            let peak = seen.opacity * seen.variance / variance;
            let radius = EXTENT * variance.sqrt();
            for (row, column) in blocks((seen.x, seen.y), radius, (columns, rows)) {
                let (x, y) = (column as f32 + 0.5 - seen.x, row as f32 + 0.5 - seen.y);
                let alpha = (peak * (-0.5 * (x * x + y * y) / variance).exp()).min(0.99);
                let block = row * columns + column;
                let passing = &mut transmittance[block as usize];
                if alpha >= LEAST_ALPHA && *passing >= LEAST_TRANSMITTANCE {
                    coverage.shares.push((block, seen.gaussian, *passing * alpha));
                    *passing *= 1.0 - alpha;
                }
            }
        }
        coverage
    }

    /// Whether one of some Gaussians is in a camera's view, in front of others or not.
    pub fn any_in_view(cloud: &GaussianCloud, camera: &ViewCamera, gaussians: &[u32]) -> bool {
        let projection = Projection::new(cloud, camera);
        gaussians.iter().any(|gaussian| projection.of(*gaussian).is_some())
    }

    /// Number of blocks.
    pub fn blocks(&self) -> usize {
        (self.columns * self.rows) as usize
    }

    /// A value of each block as one of each pixel of an image of this size, row-major.
    pub fn to_pixels<T: Copy>(&self, of_blocks: &[T], width: u32, height: u32) -> Vec<T> {
        let block = |x: u32, y: u32| of_blocks[(y / BLOCK * self.columns + x / BLOCK) as usize];
        (0..height).flat_map(|y| (0..width).map(move |x| block(x, y))).collect()
    }

    /// The blocks with their neighbours.
    pub fn widened(&self, blocks: &[bool]) -> Vec<bool> {
        let (columns, rows) = (self.columns as usize, self.rows as usize);
        let near = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
        let any = |row: usize, column: usize| {
            near(row, rows).any(|row| near(column, columns).any(|column| blocks[row * columns + column]))
        };
        (0..blocks.len()).map(|block| any(block / columns, block % columns)).collect()
    }
}

/// A camera's projection into blocks.
struct Projection<'a> {
    cloud: &'a GaussianCloud,
    axes: [Vec3; 3],
    translation: [f32; 3],
    pinhole: Pinhole,
    columns: f32,
    rows: f32,
}

impl<'a> Projection<'a> {
    fn new(cloud: &'a GaussianCloud, camera: &ViewCamera) -> Self {
        let (pinhole, (axes, translation)) = (camera.pinhole, camera.rows());
        let [columns, rows] = size(&pinhole).map(|blocks| blocks as f32);
        Self { cloud, axes, translation, pinhole, columns, rows }
    }

    /// A Gaussian, if it is in view.
    fn of(&self, gaussian: u32) -> Option<Seen> {
        let (i, cloud, pinhole) = (gaussian as usize, self.cloud, &self.pinhole);
        let along = |axis: usize| self.axes[axis].dot(cloud.means[i]) + self.translation[axis];
        let depth = along(2);
        if !(depth > NEAR_METRES as f32 && depth.is_finite()) {
            return None;
        }
        // Pixel centres are whole numbers; the first block begins half a pixel before the first centre.
        let in_blocks = |pixel: f32| (pixel + 0.5) / BLOCK as f32;
        let x = in_blocks(pinhole.fx as f32 * along(0) / depth + pinhole.cx as f32);
        let y = in_blocks(pinhole.fy as f32 * along(1) / depth + pinhole.cy as f32);
        let log_scale = cloud.log_scales[i];
        let size = (0.5 * (log_scale.element_sum() - log_scale.min_element())).exp();
        let deviation = size * pinhole.fx as f32 / depth / BLOCK as f32;
        let radius = EXTENT * (deviation * deviation + BLOCK_VARIANCE).sqrt();
        let inside = x + radius > 0.0 && y + radius > 0.0 && x - radius < self.columns && y - radius < self.rows;
        let opacity = || opacity_from_raw(cloud.raw_opacities[i]);
        inside.then(|| Seen { gaussian, depth, x, y, variance: deviation * deviation, opacity: opacity() })
    }
}

/// Columns and rows of blocks in an image.
fn size(pinhole: &Pinhole) -> [u32; 2] {
    [pinhole.width, pinhole.height].map(|side| side.div_ceil(BLOCK))
}

/// The Gaussians in view, front to back.
fn seen(cloud: &GaussianCloud, camera: &ViewCamera) -> Vec<Seen> {
    let projection = Projection::new(cloud, camera);
    let mut seen: Vec<Seen> = (0..cloud.len() as u32).filter_map(|gaussian| projection.of(gaussian)).collect();
    seen.sort_unstable_by(|a, b| a.depth.total_cmp(&b.depth).then(a.gaussian.cmp(&b.gaussian)));
    seen
}

/// Row and column of the blocks whose centres may lie within a radius.
fn blocks((x, y): (f32, f32), radius: f32, (columns, rows): (u32, u32)) -> impl Iterator<Item = (u32, u32)> {
    let range = |at: f32, end: u32| (at - radius).floor().max(0.0) as u32..((at + radius).ceil().max(0.0) as u32).min(end);
    let of_row = range(x, columns);
    range(y, rows).flat_map(move |row| of_row.clone().map(move |column| (row, column)))
}

#[cfg(test)]
mod tests {
    use glam::Quat;

    use super::*;
    use crate::geometry::Se3;
    use crate::splat::{Gaussian, ShDegree};

    fn camera() -> ViewCamera {
        let pinhole = Pinhole { fx: 64.0, fy: 64.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
        ViewCamera { pinhole, camera_from_world: Se3::identity() }
    }

    fn cloud(gaussians: &[(Vec3, f32)]) -> GaussianCloud {
        let mut cloud = GaussianCloud::new(ShDegree::new(0).unwrap());
        for (mean, scale) in gaussians {
            let log_scale = Vec3::splat(scale.ln());
            cloud.push(Gaussian { mean: *mean, log_scale, rotation: Quat::IDENTITY, raw_opacity: 4.0, sh: vec![Vec3::ONE] });
        }
        cloud
    }

    fn of(coverage: &Coverage, gaussian: u32) -> f32 {
        coverage.shares.iter().filter(|(_, g, _)| *g == gaussian).map(|(.., share)| share).sum()
    }

    #[test]
    fn a_gaussian_covers_as_much_as_its_integral_says() {
        let coverage = Coverage::of(&cloud(&[(Vec3::new(0.0, 0.0, 2.0), 0.1)]), &camera());
        let deviation = 0.1 * 64.0 / 2.0 / 8.0;
        let expected = opacity_from_raw(4.0) * std::f32::consts::TAU * deviation * deviation;
        assert!((of(&coverage, 0) / expected - 1.0).abs() < 0.05, "{} {expected}", of(&coverage, 0));
        assert_eq!((coverage.columns, coverage.rows, coverage.blocks()), (8, 6, 48));
    }

    #[test]
    fn what_is_hidden_behind_the_camera_or_beside_the_image_is_not_seen() {
        let wall = (Vec3::new(0.0, 0.0, 1.0), 2.0);
        let hidden = (Vec3::new(0.0, 0.0, 3.0), 0.5);
        let elsewhere = [(Vec3::new(0.0, 0.0, -1.0), 0.1), (Vec3::new(9.0, 0.0, 1.0), 0.1), (Vec3::splat(f32::NAN), 0.1)];
        let coverage = Coverage::of(&cloud(&[hidden, wall, elsewhere[0], elsewhere[1], elsewhere[2]]), &camera());
        assert!(of(&coverage, 1) > 40.0 && of(&coverage, 0) < 0.05 * of(&coverage, 1));
        assert!((2..5).all(|gaussian| of(&coverage, gaussian) == 0.0));
    }

    #[test]
    fn blocks_become_pixels_and_widen() {
        let coverage = Coverage { columns: 3, rows: 2, shares: Vec::new() };
        let blocks = [true, false, false, false, false, false];
        assert_eq!(coverage.widened(&blocks), [true, true, false, true, true, false]);
        let pixels = coverage.to_pixels(&blocks, 20, 10);
        assert_eq!((pixels.len(), pixels.iter().filter(|inside| **inside).count()), (200, 64));
        assert!(pixels[7 * 20 + 7] && !pixels[8 * 20 + 7] && !pixels[8]);
    }
}
