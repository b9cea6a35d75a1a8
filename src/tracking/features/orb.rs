//! ORB features spread evenly over the image (Rublee et al., *ORB*, ICCV 2011; the even spread after Mur-Artal & Tardós,
//! *ORB-SLAM2*, 2017).
//!
//! OpenCV finds FAST corners on each pyramid level and computes the descriptors; choosing the corners (a quadtree, with a lower
//! threshold where there is no texture) and their orientation (intensity centroid) is done here, so that descriptors are computed
//! only for those that stay. Levels are worked on in parallel, each by itself: the result does not depend on threads.

use std::sync::Once;

use nalgebra::Vector2;
use opencv::core::{KeyPoint, KeyPointTraitConst, Mat, MatTraitConst, MatTraitConstManual, Rect, Size, Vector};
use opencv::features2d::{self, Feature2DTrait};
use opencv::imgproc;
use rayon::prelude::*;

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::quadtree::{Corner, distribute};
use crate::tracking::{TrackingConfig, TrackingError};

/// Pixels at a level's border without features: the descriptor's patch (31 pixels) must fit.
const BORDER: i32 = 16;
/// Radius of the orientation patch, pixels.
const PATCH_RADIUS: i32 = 15;
const PATCH_COLUMNS: usize = 2 * PATCH_RADIUS as usize + 2;
/// Side of the squares that are searched again with the lower threshold if they have no corner, pixels.
const TEXTURE_CELL: i32 = 32;
/// FAST looks this far around a pixel.
const FAST_RADIUS: i32 = 3;

/// A keypoint in the recorded (distorted) image at full size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    pub pixel: Vector2<f64>,
    pub octave: u8,
    pub angle_rad: f32,
    pub descriptor: Descriptor,
}

/// An image at falling sizes, finest first.
#[derive(Clone, Debug)]
pub struct Pyramid {
    levels: Vec<Mat>,
}

/// One level of a pyramid.
#[derive(Clone, Copy, Debug)]
pub struct LevelImage<'a> {
    /// Row-major `[height * width]`.
    pub pixels: &'a [u8],
    pub width: usize,
    pub height: usize,
}

impl Pyramid {
    pub fn level(&self, octave: u8) -> Result<LevelImage<'_>, TrackingError> {
        let image = &self.levels[usize::from(octave)];
        Ok(LevelImage { pixels: image.data_bytes()?, width: image.cols() as usize, height: image.rows() as usize })
    }
}

/// The extractor with its level sizes worked out.
#[derive(Clone, Debug)]
pub struct Extractor {
    levels: Vec<Level>,
    threshold: i32,
    threshold_low: i32,
    /// Rows `0..=PATCH_RADIUS` of the round orientation patch.
    patch_rows: Vec<PatchRow>,
}

/// A row of the orientation patch, as wide as the widest and a column more, which makes whole vectors.
#[derive(Clone, Debug)]
struct PatchRow {
    /// 1 inside the round patch, 0 outside.
    inside: [i16; PATCH_COLUMNS],
    /// The distance from the corner's column inside, 0 outside.
    column: [i16; PATCH_COLUMNS],
}

#[derive(Clone, Debug)]
struct Level {
    size: Size,
    budget: usize,
}

impl Extractor {
    /// `features` are kept of each image.
    pub fn new(width: u32, height: u32, features: usize, config: &TrackingConfig) -> Self {
        // Frames and levels run side by side: threads of OpenCV's own are in their way. Only the speed depends on it. Once: OpenCV's pool must
        // not be changed while another thread uses it.
        static ONE_THREAD: Once = Once::new();
        ONE_THREAD.call_once(|| drop(opencv::core::set_num_threads(1)));
        let scale = |level: usize| config.pyramid_scale.powi(level as i32);
        let total: f64 = (0..config.pyramid_levels).map(|l| 1.0 / scale(l)).sum();
        let levels = (0..config.pyramid_levels)
            .map(|l| Level {
                size: Size::new((f64::from(width) / scale(l)).round() as i32, (f64::from(height) / scale(l)).round() as i32),
                budget: (features as f64 / scale(l) / total).round() as usize,
            })
            // A level must hold the border twice and something between.
            .take_while(|level| level.size.width > 2 * BORDER + 8 && level.size.height > 2 * BORDER + 8)
            .collect();
        let radius = f64::from(PATCH_RADIUS) + 0.5;
        let patch_row = |v: i32| {
            let half = (radius * radius - f64::from(v * v)).sqrt() as i16;
            let column: [i16; PATCH_COLUMNS] = std::array::from_fn(|k| k as i16 - PATCH_RADIUS as i16);
            let inside = column.map(|c| i16::from(c.abs() <= half));
            PatchRow { inside, column: std::array::from_fn(|k| inside[k] * column[k]) }
        };
        let patch_rows = (0..=PATCH_RADIUS).map(patch_row).collect();
        Self {
            levels,
            threshold: config.fast_threshold.into(),
            threshold_low: config.fast_threshold_low_texture.into(),
            patch_rows,
        }
    }

    /// The pyramid of a grey image (row-major, the size this was made for); without levels where it is too small for any feature.
    pub fn pyramid(&self, grey: &[u8]) -> Result<Pyramid, TrackingError> {
        let Some(first) = self.levels.first() else { return Ok(Pyramid { levels: Vec::new() }) };
        let base = Mat::new_rows_cols_with_data(first.size.height, first.size.width, grey)?;
        let mut levels: Vec<Mat> = vec![base.try_clone()?];
        for level in &self.levels[1..] {
            let mut smaller = Mat::default();
            imgproc::resize(&levels[levels.len() - 1], &mut smaller, level.size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
            levels.push(smaller);
        }
        Ok(Pyramid { levels })
    }

    /// Keypoints of a pyramid, level by level.
    pub fn extract(&self, pyramid: &Pyramid) -> Result<Vec<Keypoint>, TrackingError> {
        let per_level: Vec<Result<Vec<Keypoint>, TrackingError>> =
            pyramid.levels.par_iter().enumerate().map(|(octave, image)| self.extract_level(image, octave)).collect();
        let mut keypoints = Vec::new();
        for level in per_level {
            keypoints.extend(level?);
        }
        Ok(keypoints)
    }

    fn extract_level(&self, image: &Mat, octave: usize) -> Result<Vec<Keypoint>, TrackingError> {
        let corners = distribute(self.detect(image)?, image.cols(), image.rows(), self.levels[octave].budget);
        if corners.is_empty() {
            return Ok(Vec::new());
        }
        let pixels = image.data_bytes()?;
        let angles: Vec<f32> = corners.iter().map(|c| self.orientation(pixels, image.cols(), c)).collect();
        let mut keypoints: Vector<KeyPoint> = Vector::with_capacity(corners.len());
        for (index, (corner, angle_rad)) in corners.iter().zip(&angles).enumerate() {
            let (x, y) = (corner.x as f32, corner.y as f32);
            keypoints.push(KeyPoint::new_coords(x, y, 31.0, angle_rad.to_degrees(), corner.score, 0, index as i32)?);
        }
        let mut orb = features2d::ORB::create(1, 1.2, 1, BORDER, 0, 2, features2d::ORB_ScoreType::FAST_SCORE, 31, 20)?;
        let mut descriptors = Mat::default();
        orb.compute(image, &mut keypoints, &mut descriptors)?;
        // Pixel centres stay where they belong when an image is resized: (x + ½)·s − ½.
        let full = self.levels[0].size;
        let sx = f64::from(full.width) / f64::from(image.cols());
        let sy = f64::from(full.height) / f64::from(image.rows());
        let mut found = Vec::with_capacity(keypoints.len());
        for row in 0..keypoints.len() {
            let index = keypoints.get(row)?.class_id() as usize;
            let corner = &corners[index];
            found.push(Keypoint {
                pixel: Vector2::new((f64::from(corner.x) + 0.5) * sx - 0.5, (f64::from(corner.y) + 0.5) * sy - 0.5),
                octave: octave as u8,
                angle_rad: angles[index],
                descriptor: Descriptor::from_bytes(descriptors.at_row::<u8>(row as i32)?),
            });
        }
        Ok(found)
    }

    /// All FAST corners inside the border; squares without any are searched again with the lower threshold.
    fn detect(&self, image: &Mat) -> Result<Vec<Corner>, TrackingError> {
        let (width, height) = (image.cols(), image.rows());
        let inside = |x: i32, y: i32| x >= BORDER && y >= BORDER && x < width - BORDER && y < height - BORDER;
        let mut corners = Vec::new();
        fast_corners(image, self.threshold, (0, 0), &inside, &mut corners)?;
        let cells_x = (width - 2 * BORDER + TEXTURE_CELL - 1) / TEXTURE_CELL;
        let cells_y = (height - 2 * BORDER + TEXTURE_CELL - 1) / TEXTURE_CELL;
        let mut textured = vec![false; (cells_x * cells_y) as usize];
        for c in &corners {
            textured[((c.y - BORDER) / TEXTURE_CELL * cells_x + (c.x - BORDER) / TEXTURE_CELL) as usize] = true;
        }
        for (cell, _) in textured.iter().enumerate().filter(|(_, has_corner)| !**has_corner) {
            let (x0, y0) = (
                BORDER + cell as i32 % cells_x * TEXTURE_CELL - FAST_RADIUS,
                BORDER + cell as i32 / cells_x * TEXTURE_CELL - FAST_RADIUS,
            );
            let x1 = (x0 + TEXTURE_CELL + 2 * FAST_RADIUS).min(width);
            let y1 = (y0 + TEXTURE_CELL + 2 * FAST_RADIUS).min(height);
            let square = image.roi(Rect::new(x0, y0, x1 - x0, y1 - y0))?;
            fast_corners(&square, self.threshold_low, (x0, y0), &inside, &mut corners)?;
        }
        Ok(corners)
    }

    /// Direction from a corner to the intensity centroid of the round patch about it, radians in `[0, 2π)`.
    fn orientation(&self, pixels: &[u8], width: i32, corner: &Corner) -> f32 {
        let (mut m10, mut m01) = (0i64, 0i64);
        for v in -PATCH_RADIUS..=PATCH_RADIUS {
            let row = &self.patch_rows[v.unsigned_abs() as usize];
            let start = ((corner.y + v) * width + corner.x - PATCH_RADIUS) as usize;
            let (mut row_sum, mut row_moment) = (0i32, 0i32);
            for ((value, inside), column) in pixels[start..start + PATCH_COLUMNS].iter().zip(&row.inside).zip(&row.column) {
                row_sum += i32::from(*value) * i32::from(*inside);
                row_moment += i32::from(*value) * i32::from(*column);
            }
            m10 += i64::from(row_moment);
            m01 += i64::from(v * row_sum);
        }
        (m01 as f32).atan2(m10 as f32).rem_euclid(std::f32::consts::TAU)
    }
}

fn fast_corners(
    image: &impl opencv::core::ToInputArray,
    threshold: i32,
    (x0, y0): (i32, i32),
    inside: &impl Fn(i32, i32) -> bool,
    corners: &mut Vec<Corner>,
) -> Result<(), TrackingError> {
    let mut found: Vector<KeyPoint> = Vector::new();
    features2d::fast(image, &mut found, threshold, true)?;
    for keypoint in &found {
        let at = keypoint.pt();
        let (x, y) = (at.x as i32 + x0, at.y as i32 + y0);
        if inside(x, y) {
            corners.push(Corner { x, y, score: keypoint.response() });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> TrackingConfig {
        TrackingConfig::default()
    }

    /// Random dots of many grey levels, blurred; the right half is of low contrast.
    fn picture() -> Vec<u8> {
        let mut random = fastrand::Rng::with_seed(7);
        let mut dots: Vec<f64> = (0..320 * 240).map(|_| if random.u8(0..12) == 0 { 255.0 * random.f64() } else { 0.0 }).collect();
        for (stride, length) in [(1, 320), (320, 240), (1, 320), (320, 240)] {
            let sharp = dots.clone();
            for (i, value) in dots.iter_mut().enumerate() {
                let place = i / stride % length;
                let before = if place > 0 { sharp[i - stride] } else { sharp[i] };
                let after = if place + 1 < length { sharp[i + stride] } else { sharp[i] };
                *value = (before + sharp[i] + after) * 0.55;
            }
        }
        let contrast = |i: usize| if i % 320 < 160 { 1.0 } else { 0.08 };
        dots.iter().enumerate().map(|(i, v)| (20.0 + v.min(200.0) * contrast(i)) as u8).collect()
    }

    fn extract(extractor: &Extractor, grey: &[u8]) -> Vec<Keypoint> {
        extractor.extract(&extractor.pyramid(grey).unwrap()).unwrap()
    }

    #[test]
    fn features_cover_textured_and_faint_halves() {
        let keypoints = extract(&Extractor::new(320, 240, 500, &config()), &picture());
        let left = keypoints.iter().filter(|k| k.pixel.x < 160.0).count();
        assert!((300..=600).contains(&keypoints.len()), "{} features", keypoints.len());
        assert!(left > 100 && keypoints.len() - left > 100, "{left} of {} are on the left", keypoints.len());
        assert!(keypoints.iter().any(|k| k.octave > 4));
    }

    #[test]
    fn a_turned_picture_has_turned_angles_and_the_same_descriptors() {
        let picture = picture();
        let turned: Vec<u8> = picture.iter().rev().copied().collect();
        let extractor = Extractor::new(320, 240, 500, &config());
        let (a, b) = (extract(&extractor, &picture), extract(&extractor, &turned));
        let mut same = 0;
        for k in a.iter().filter(|k| k.octave == 0) {
            let there = Vector2::new(319.0, 239.0) - k.pixel;
            let Some(other) = b.iter().find(|o| o.octave == 0 && (o.pixel - there).norm() < 0.5) else { continue };
            let turn = (other.angle_rad - k.angle_rad).rem_euclid(std::f32::consts::TAU);
            assert!((turn - std::f32::consts::PI).abs() < 1e-3);
            same += usize::from(other.descriptor.distance(&k.descriptor) < 40);
        }
        assert!(same > 50, "{same}");
    }

    #[test]
    fn blank_pictures_have_no_features() {
        assert!(extract(&Extractor::new(320, 240, 500, &config()), &vec![0; 320 * 240]).is_empty());
        assert!(extract(&Extractor::new(16, 16, 500, &config()), &[0; 256]).is_empty());
    }
}
