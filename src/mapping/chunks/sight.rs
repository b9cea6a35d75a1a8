//! What a keyframe can see: how deep its image is, block by block, and which balls lie in it. Found on the CPU, by the keyframe's own depth, so that
//! what walls hide counts as unseen.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::Ball;
use crate::geometry::Pinhole;
use crate::gpu::plain;
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
        for (y, line) in image.depth.iter().flat_map(|depth| depth.metres.chunks_exact(width as usize)).enumerate() {
            let row = &mut farthest[y / BLOCK as usize * columns as usize..][..columns as usize];
            for (block, metres) in row.iter_mut().zip(line.chunks(BLOCK as usize)) {
                *block = metres.iter().fold(*block, |most, metres| most.max(*metres));
            }
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
    /// Whether a part of the ball lies in the image and not behind all that the image shows there.
    pub fn sees(&self, ball: &Ball) -> bool {
        let along = |axis: usize| self.axes[axis].dot(ball.center()) + self.translation[axis];
        let (z, radius) = (along(2), ball.radius());
        if z + radius < NEAR_METRES as f32 {
            return false;
        }
        let (columns, rows) = (self.sight.columns, self.sight.farthest.len() as u32 / self.sight.columns);
        let nearest = z - radius;
        if nearest < NEAR_METRES as f32 {
            // It surrounds the camera, or reaches through the image's plane: its outline says nothing.
            return self.reaches(along(0), along(1), z, radius);
        }
        // Within a ball, x/z differs from that of its middle by no more than r·√(z² + x²) / (z·(z - r)).
        let blocks = |center: f32, focal: f64, middle: f64, count: u32| {
            let slope = center / z;
            let (pixel, reach) =
                (focal as f32 * slope + middle as f32, focal as f32 * radius * (1.0 + slope * slope).sqrt() / nearest + EDGE);
            let block = |pixel: f32| (pixel + 0.5) / BLOCK as f32;
            let (low, high) = (block(pixel - reach).floor().max(0.0), block(pixel + reach).floor().min(count as f32 - 1.0));
            low as u32..(high + 1.0).max(0.0) as u32
        };
        let across = blocks(along(0), self.pinhole.fx, self.pinhole.cx, columns);
        let down = blocks(along(1), self.pinhole.fy, self.pinhole.cy, rows);
        let reached = |row: u32| {
            let line = &self.sight.farthest[(row * columns) as usize..][..columns as usize];
            across.clone().any(|column| line[column as usize] * DEPTH_MARGIN >= nearest)
        };
        down.into_iter().any(reached)
    }

    /// Whether the view may see a ball within this one: a coarser question than [`Self::sees`].
    pub fn faces(&self, ball: &Ball) -> bool {
        let (z, radius) = (self.depth(ball), ball.radius());
        z + radius >= NEAR_METRES as f32 && z - radius <= self.most * DEPTH_MARGIN
    }

    /// Depth of the ball's middle, metres.
    pub fn depth(&self, ball: &Ball) -> f32 {
        self.axes[2].dot(ball.center()) + self.translation[2]
    }

    /// Distance of the ball's middle from the camera, metres.
    pub fn distance(&self, ball: &Ball) -> f32 {
        let along = |axis: usize| self.axes[axis].dot(ball.center()) + self.translation[axis];
        Vec3::new(along(0), along(1), along(2)).length()
    }

    /// Whether a ball around the camera reaches into the pyramid of its view.
    fn reaches(&self, x: f32, y: f32, z: f32, radius: f32) -> bool {
        let (columns, rows) = (self.sight.columns, self.sight.farthest.len() as u32 / self.sight.columns);
        let side = |center: f32, focal: f64, middle: f64, blocks: u32| {
            let slope = |pixel: f64| ((pixel - 0.5 - middle) / focal) as f32;
            let (low, high) = (slope(-f64::from(EDGE)), slope(f64::from(blocks * BLOCK) + f64::from(EDGE)));
            let distance = |slope: f32, sign: f32| sign * (center - slope * z) / (1.0 + slope * slope).sqrt();
            distance(low, 1.0) > -radius && distance(high, -1.0) > -radius
        };
        let Pinhole { fx, fy, cx, cy, .. } = self.pinhole;
        side(x, fx, cx, columns) && side(y, fy, cy, rows)
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

    fn ball(x: f32, y: f32, z: f32, radius: f32) -> Ball {
        Ball([x, y, z, radius])
    }

    #[test]
    fn what_lies_before_the_surface_is_seen_and_what_lies_behind_is_not() {
        let (sight, camera) = sight();
        let outlook = sight.from(&camera);
        for (seen, ball) in [
            (true, ball(-0.5, 0.0, 1.9, 0.1)),
            (true, ball(-0.5, 0.0, 2.1, 0.1)),
            (false, ball(-0.8, 0.0, 2.5, 0.1)),
            (true, ball(0.8, 0.0, 2.5, 0.1)),
            (true, ball(1.0, 0.0, 9.2, 0.1)),
            (false, ball(1.0, 0.0, 9.6, 0.1)),
            (false, ball(0.0, 0.0, -1.0, 0.5)),
            (true, ball(0.0, 0.0, -0.2, 0.5)),
            (false, ball(3.0, 0.0, 2.0, 0.2)),
            (false, ball(-3.0, 0.0, 0.2, 0.5)),
            (false, ball(0.0, 5.0, 2.0, 0.2)),
            (true, ball(1.7, 0.0, 3.0, 0.4)),
        ] {
            assert_eq!(outlook.sees(&ball), seen, "{ball:?}");
        }
    }

    #[test]
    fn the_camera_moves_and_depth_may_be_unknown() {
        let (mut sight, camera) = sight();
        let moved = ViewCamera { camera_from_world: Se3::translation(0.0, 0.0, -10.0), ..camera };
        assert!(sight.from(&moved).sees(&ball(-0.5, 0.0, 11.5, 0.1)) && !sight.from(&moved).sees(&ball(-0.5, 0.0, 1.5, 0.1)));
        sight.scale(2.0);
        assert!(sight.from(&camera).sees(&ball(-0.8, 0.0, 2.5, 0.1)));
        let image = RectifiedImage { pinhole: camera.pinhole, color: RgbImage::new(64, 48), depth: None, valid: None };
        assert!(Sight::of(&image).from(&camera).sees(&ball(0.0, 0.0, 1e4, 0.1)));
    }
}
