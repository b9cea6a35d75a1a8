//! What a keyframe can see: how deep its image is, block by block, and which boxes lie in it. Found on the CPU, by the keyframe's own depth, so that
//! what walls hide counts as unseen.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::OrientedBox;
use crate::geometry::Pinhole;
use crate::gpu::plain;
use crate::optimise::Pixels;
use crate::sequence::RectifiedImage;
use crate::splat::ViewCamera;
use crate::splat::model::NEAR_METRES;

/// Side of a block, pixels.
const BLOCK: u32 = 4;
/// Depth errs by so much of itself.
const DEPTH_MARGIN: f32 = 1.03;
/// A pixel's footprint reaches so far beyond the image, pixels.
const EDGE: f32 = 2.0;

/// The depth of an image.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::mapping) struct Sight {
    columns: u32,
    /// `[rows, columns]` largest depth in each block, metres; the largest of all where a block has none, infinite where no block has any.
    #[serde(with = "plain")]
    farthest: Vec<f32>,
}

impl Sight {
    pub fn of(image: &RectifiedImage) -> Self {
        let Pinhole { width, height, .. } = image.pinhole;
        let (columns, rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let mut farthest = vec![0.0f32; (columns * rows) as usize];
        if let Some(depth) = &image.depth {
            let stripes = depth.metres.par_chunks((width * BLOCK) as usize);
            farthest.par_chunks_mut(columns as usize).zip(stripes).for_each(|(row, stripe)| {
                for line in stripe.chunks_exact(width as usize) {
                    for (block, metres) in row.iter_mut().zip(line.chunks(BLOCK as usize)) {
                        *block = metres.iter().fold(*block, |most, metres| most.max(*metres));
                    }
                }
            });
        }
        let most = farthest.iter().fold(0.0, |most: f32, metres| most.max(*metres));
        let unknown = if most > 0.0 { most } else { f32::INFINITY };
        farthest.iter_mut().filter(|metres| **metres <= 0.0).for_each(|metres| *metres = unknown);
        Self { columns, farthest }
    }

    /// Depth was estimated, and its unit has changed.
    pub fn scale(&mut self, scale: f32) {
        self.farthest.iter_mut().for_each(|metres| *metres *= scale);
    }

    pub fn from<'a>(&'a self, camera: &ViewCamera) -> Outlook<'a> {
        let (axes, translation) = camera.rows();
        let most = self.farthest.iter().fold(0.0, |most: f32, metres| most.max(*metres));
        Outlook { sight: self, most, axes, translation, pinhole: camera.pinhole }
    }
}

/// The same from a pose.
pub(in crate::mapping) struct Outlook<'a> {
    sight: &'a Sight,
    /// The largest depth of all.
    most: f32,
    axes: [Vec3; 3],
    translation: [f32; 3],
    pinhole: Pinhole,
}

impl Outlook<'_> {
    /// Whether a part of the box lies in the image and not behind all that the image shows there.
    pub fn sees(&self, bounds: &OrientedBox) -> bool {
        self.reaches(bounds, |_| true)
    }

    /// Nothing of the image is hidden yet.
    pub fn nothing_hidden(&self) -> Hidden {
        let blocks = self.sight.farthest.len();
        Hidden { columns: self.sight.columns, blocks: vec![false; blocks], left: blocks }
    }

    /// Where the box is seen, the image counts as hidden.
    pub fn hide(&self, bounds: &OrientedBox, hidden: &mut Hidden) {
        let hide = |block: usize| {
            hidden.left -= usize::from(!std::mem::replace(&mut hidden.blocks[block], true));
            false
        };
        self.reaches(bounds, hide);
    }

    /// Whether the box is seen in a hidden block.
    pub fn is_hidden(&self, bounds: &OrientedBox, hidden: &Hidden) -> bool {
        self.reaches(bounds, |block| hidden.blocks[block])
    }

    /// Goes through the blocks in which the box is seen until `found` ends that; returns whether it did.
    fn reaches(&self, bounds: &OrientedBox, mut found: impl FnMut(usize) -> bool) -> bool {
        let Some(in_view) = self.in_view(bounds) else { return false };
        let (center, half_axes) = (in_view.center(), in_view.half_axes());
        let nearest = center.z - in_view.reach(Vec3::Z);
        let (columns, rows) = (self.sight.columns, self.sight.farthest.len() as u32 / self.sight.columns);
        if nearest < NEAR_METRES as f32 {
            // It surrounds the camera, or reaches through the image's plane: its outline says nothing.
            return (0..self.sight.farthest.len()).any(found);
        }
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for corner in 0..8 {
            let along = |axis: usize| if corner >> axis & 1 == 1 { half_axes[axis] } else { -half_axes[axis] };
            let corner = center + along(0) + along(1) + along(2);
            // Rounding may leave a corner a little before the nearest.
            let slopes = [corner.x, corner.y].map(|across| across / corner.z.max(nearest));
            for side in 0..2 {
                (low[side], high[side]) = (low[side].min(slopes[side]), high[side].max(slopes[side]));
            }
        }
        let blocks = |side: usize, focal: f64, middle: f64, count: u32| {
            let pixel = |slope: f32| focal as f32 * slope + middle as f32;
            let block = |pixel: f32| ((pixel + 0.5) / BLOCK as f32).floor();
            let (low, high) = (block(pixel(low[side]) - EDGE).max(0.0), block(pixel(high[side]) + EDGE).min(count as f32 - 1.0));
            low as u32..(high + 1.0).max(0.0) as u32
        };
        let across = blocks(0, self.pinhole.fx, self.pinhole.cx, columns);
        let down = blocks(1, self.pinhole.fy, self.pinhole.cy, rows);
        down.into_iter().any(|row| {
            let mut blocks = across.clone().map(|column| (row * columns + column) as usize);
            blocks.any(|block| self.sight.farthest[block] * DEPTH_MARGIN >= nearest && found(block))
        })
    }

    /// Whether the view may see a box within this one: a coarser question than [`Self::sees`].
    pub fn faces(&self, bounds: &OrientedBox) -> bool {
        self.in_view(bounds).is_some()
    }

    /// Pixels in which the view shows a surface in the middle of the box, compared with other views: the inverse square of the distance. Zero where the
    /// middle is not in the image, or behind what the image shows there.
    pub fn pixel_density(&self, bounds: &OrientedBox) -> f32 {
        let center = self.turned(bounds.center()) + Vec3::from(self.translation);
        if center.z < NEAR_METRES as f32 {
            return 0.0;
        }
        let Pinhole { fx, fy, cx, cy, .. } = self.pinhole;
        let block = |across: f32, focal: f64, middle: f64| {
            ((focal as f32 * across / center.z + middle as f32 + 0.5) / BLOCK as f32).floor()
        };
        let (x, y) = (block(center.x, fx, cx), block(center.y, fy, cy));
        let (columns, rows) = (self.sight.columns, self.sight.farthest.len() as u32 / self.sight.columns);
        let is_in_image = (0.0..columns as f32).contains(&x) && (0.0..rows as f32).contains(&y);
        let shows = |x: u32, y: u32| self.sight.farthest[(y * columns + x) as usize] * DEPTH_MARGIN >= center.z;
        if is_in_image && shows(x as u32, y as u32) { 1.0 / center.length_squared() } else { 0.0 }
    }

    /// Depth of the box's middle, metres.
    pub fn depth(&self, bounds: &OrientedBox) -> f32 {
        self.axes[2].dot(bounds.center()) + self.translation[2]
    }

    /// The box in the camera's frame; none if it does not reach into the pyramid of the view, or lies behind all that the view shows.
    fn in_view(&self, bounds: &OrientedBox) -> Option<OrientedBox> {
        let center = self.turned(bounds.center()) + Vec3::from(self.translation);
        let in_camera = OrientedBox::new(center, bounds.half_axes().map(|axis| self.turned(axis)));
        let depth_reach = in_camera.reach(Vec3::Z);
        if center.z + depth_reach < NEAR_METRES as f32 || center.z - depth_reach > self.most * DEPTH_MARGIN {
            return None;
        }
        let (columns, rows) = (self.sight.columns, self.sight.farthest.len() as u32 / self.sight.columns);
        // Planes through the camera and a side of the image.
        let is_inside = |axis: usize, focal: f64, middle: f64, blocks: u32| {
            let slope = |pixel: f64| ((pixel - 0.5 - middle) / focal) as f32;
            let (low, high) = (slope(-f64::from(EDGE)), slope(f64::from(blocks * BLOCK) + f64::from(EDGE)));
            [(low, 1.0), (high, -1.0)].into_iter().all(|(slope, inwards)| {
                let mut normal = Vec3::new(0.0, 0.0, -slope);
                normal[axis] = 1.0;
                let normal = inwards * normal / (1.0 + slope * slope).sqrt();
                normal.dot(center) > -in_camera.reach(normal)
            })
        };
        let Pinhole { fx, fy, cx, cy, .. } = self.pinhole;
        (is_inside(0, fx, cx, columns) && is_inside(1, fy, cy, rows)).then_some(in_camera)
    }

    fn turned(&self, v: Vec3) -> Vec3 {
        Vec3::from(self.axes.map(|axis| axis.dot(v)))
    }
}

/// Blocks of an image that show something that is away.
#[derive(Clone, Debug)]
pub(in crate::mapping) struct Hidden {
    columns: u32,
    blocks: Vec<bool>,
    /// Of these, so many show nothing that is away.
    left: usize,
}

impl Hidden {
    /// Share of the image in which all is here, 0 to 1.
    pub fn seen(&self) -> f32 {
        self.left as f32 / self.blocks.len().max(1) as f32
    }

    /// Leaves out the pixels of an image so many pixels wide, of half the size if `halved`: `mark` stands in their place.
    pub fn leave_out(&self, pixels: &mut Pixels, width: u32, halved: bool, mark: u32) {
        let side = if halved { BLOCK / 2 } else { BLOCK };
        let rows = pixels.color.chunks_mut(width as usize).zip(pixels.depth_metres.chunks_mut(width as usize));
        for (y, (colors, depths)) in (0..).zip(rows) {
            let line = &self.blocks[(y / side * self.columns) as usize..][..self.columns as usize];
            for (x, (color, metres)) in (0..).zip(colors.iter_mut().zip(depths)) {
                if line[(x / side) as usize] {
                    (*color, *metres) = (mark, 0.0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use image::RgbImage;

    use super::*;
    use crate::geometry::Se3;
    use crate::sequence::DepthImage;

    /// A wall at two metres on the left, an opening of nine metres on the right.
    fn sight() -> (Sight, ViewCamera) {
        let pinhole = Pinhole { fx: 64.0, fy: 64.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
        let metres = (0..64 * 48).map(|i| if i % 64 < 32 { 2.0 } else { 9.0 }).collect();
        let depth = Some(DepthImage { width: 64, height: 48, metres });
        let image = RectifiedImage { pinhole, color: RgbImage::new(64, 48), depth, valid: None };
        (Sight::of(&image), ViewCamera { pinhole, camera_from_world: Se3::identity() })
    }

    fn cube(x: f32, y: f32, z: f32, half: f32) -> OrientedBox {
        OrientedBox::cube(Vec3::new(x, y, z), half)
    }

    #[test]
    fn what_lies_before_the_surface_is_seen_and_what_lies_behind_is_not() {
        let (sight, camera) = sight();
        let outlook = sight.from(&camera);
        for (seen, cube) in [
            (true, cube(-0.5, 0.0, 1.9, 0.1)),
            (true, cube(-0.5, 0.0, 2.1, 0.1)),
            (false, cube(-0.8, 0.0, 2.5, 0.1)),
            (true, cube(0.8, 0.0, 2.5, 0.1)),
            (true, cube(1.0, 0.0, 9.2, 0.1)),
            (false, cube(1.0, 0.0, 9.6, 0.1)),
            (false, cube(0.0, 0.0, -1.0, 0.5)),
            (true, cube(0.0, 0.0, -0.2, 0.5)),
            (false, cube(3.0, 0.0, 2.0, 0.2)),
            (false, cube(-3.0, 0.0, 0.2, 0.5)),
            (false, cube(0.0, 5.0, 2.0, 0.2)),
            (true, cube(1.7, 0.0, 3.0, 0.4)),
        ] {
            assert_eq!(outlook.sees(&cube), seen, "{cube:?}");
            assert!(!seen || outlook.faces(&cube), "{cube:?}");
            let mut hidden = outlook.nothing_hidden();
            outlook.hide(&cube, &mut hidden);
            assert_eq!(hidden.seen() < 1.0, seen, "{cube:?}");
        }
    }

    #[test]
    fn near_views_have_more_pixels_of_it_and_walls_leave_none() {
        let (sight, camera) = sight();
        let outlook = sight.from(&camera);
        let pixels = |x: f32, z: f32| outlook.pixel_density(&cube(x, 0.0, z, 0.3));
        assert!((pixels(0.4, 4.0) / pixels(0.8, 8.0) - 4.0).abs() < 1e-4);
        assert!(pixels(-0.5, 2.0) > 0.0 && pixels(-0.5, 2.1) == 0.0);
        assert_eq!([pixels(0.0, -1.0), pixels(3.0, 2.0), pixels(0.5, 9.5)], [0.0; 3]);
    }

    #[test]
    fn pixels_are_left_out_where_something_is_hidden() {
        let (sight, camera) = sight();
        let outlook = sight.from(&camera);
        let mut hidden = outlook.nothing_hidden();
        // In the opening, beside the wall and partly behind it.
        outlook.hide(&cube(0.2, 0.0, 4.0, 0.4), &mut hidden);
        let mut shares = Vec::new();
        for (width, halved) in [(64, false), (32, true)] {
            let count = (width * width * 3 / 4) as usize;
            let mut pixels = Pixels { color: vec![7; count], depth_metres: vec![1.0; count] };
            hidden.leave_out(&mut pixels, width, halved, 1);
            let is_left_out = |x: u32, y: u32| pixels.color[(y * width + x) as usize] == 1;
            assert!(is_left_out(width * 9 / 16, width * 3 / 8) && !is_left_out(width * 7 / 16, width * 3 / 8));
            assert!(!is_left_out(width * 9 / 16, 0) && !is_left_out(width - 1, width * 3 / 8));
            assert!(pixels.color.iter().zip(&pixels.depth_metres).all(|(color, metres)| (*color == 1) == (*metres == 0.0)));
            shares.push(pixels.color.iter().filter(|color| **color != 1).count() as f32 / count as f32);
        }
        assert_eq!(shares, [hidden.seen(); 2]);
    }

    #[test]
    fn the_camera_moves_and_depth_may_be_unknown() {
        let (mut sight, camera) = sight();
        let moved = ViewCamera { camera_from_world: Se3::translation(0.0, 0.0, -10.0), ..camera };
        assert!(sight.from(&moved).sees(&cube(-0.5, 0.0, 11.5, 0.1)) && !sight.from(&moved).sees(&cube(-0.5, 0.0, 1.5, 0.1)));
        sight.scale(2.0);
        assert!(sight.from(&camera).sees(&cube(-0.8, 0.0, 2.5, 0.1)));
        let image = RectifiedImage { pinhole: camera.pinhole, color: RgbImage::new(64, 48), depth: None, valid: None };
        assert!(Sight::of(&image).from(&camera).sees(&cube(0.0, 0.0, 1e4, 0.1)));
    }
}
