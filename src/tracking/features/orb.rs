//! ORB features spread evenly over the image (Rublee et al., *ORB*, ICCV 2011; the even spread after Mur-Artal & Tardós,
//! *ORB-SLAM2*, 2017).
//!
//! FAST corners are found on each pyramid level, with a lower threshold where there is no texture; a quadtree chooses among them, and those that stay
//! get an orientation and a descriptor. Levels are worked on in parallel, each by itself: the result does not depend on threads.

use std::sync::Once;

use nalgebra::Vector2;
use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Size};
use opencv::imgproc;
use rayon::prelude::*;

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::fast::{self, Window, find_corners};
use crate::tracking::features::orientation::{OrientationPatch, PATCH_RADIUS};
use crate::tracking::features::quadtree::{Corner, distribute};
use crate::tracking::features::steered_brief::{SamplingPattern, SmoothedImage};
use crate::tracking::{TrackingConfig, TrackingError};

/// Pixels at a level's border without features: the descriptor's patch (31 pixels) must fit.
const BORDER: i32 = PATCH_RADIUS + 1;
/// Side of the squares that are searched again with the lower threshold if they have no corner, pixels.
const TEXTURE_CELL: usize = 32;

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
        LevelImage::new(&self.levels[usize::from(octave)])
    }
}

impl<'a> LevelImage<'a> {
    fn new(image: &'a Mat) -> Result<Self, TrackingError> {
        Ok(Self { pixels: image.data_bytes()?, width: image.cols() as usize, height: image.rows() as usize })
    }
}

/// The extractor with its level sizes worked out.
#[derive(Clone, Debug)]
pub struct Extractor {
    levels: Vec<Level>,
    threshold: u8,
    threshold_low: u8,
    patch: OrientationPatch,
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
        Self {
            levels,
            threshold: config.fast_threshold,
            threshold_low: config.fast_threshold_low_texture,
            patch: OrientationPatch::new(),
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
        let pixels = LevelImage::new(image)?;
        let corners = distribute(self.detect(&pixels), image.cols(), image.rows(), self.levels[octave].budget);
        if corners.is_empty() {
            return Ok(Vec::new());
        }
        let angles = self.patch.angles(&pixels, &corners);
        let descriptors = SamplingPattern::get()?.describe(&SmoothedImage::new(image)?, &corners, &angles)?;
        // Pixel centres stay where they belong when an image is resized: (x + ½)·s − ½.
        let full = self.levels[0].size;
        let sx = f64::from(full.width) / f64::from(image.cols());
        let sy = f64::from(full.height) / f64::from(image.rows());
        let keypoint = |((corner, angle_rad), descriptor): ((&Corner, f32), Descriptor)| Keypoint {
            pixel: Vector2::new((f64::from(corner.x) + 0.5) * sx - 0.5, (f64::from(corner.y) + 0.5) * sy - 0.5),
            octave: octave as u8,
            angle_rad,
            descriptor,
        };
        Ok(corners.iter().zip(angles).zip(descriptors).map(keypoint).collect())
    }

    /// All FAST corners inside the border; squares without any are searched again with the lower threshold.
    fn detect(&self, image: &LevelImage<'_>) -> Vec<Corner> {
        let border = BORDER as usize;
        let (right, bottom) = (image.width - border, image.height - border);
        let mut corners = Vec::new();
        // Corners on the border can be stronger than their neighbours inside.
        find_corners(
            image,
            &Window { columns: border - 1..right + 1, rows: border - 1..bottom + 1 },
            self.threshold,
            &mut corners,
        );
        let inside = |c: &Corner| (BORDER..right as i32).contains(&c.x) && (BORDER..bottom as i32).contains(&c.y);
        corners.retain(inside);
        let columns = (right - border).div_ceil(TEXTURE_CELL);
        let mut textured = vec![false; columns * (bottom - border).div_ceil(TEXTURE_CELL)];
        for c in &corners {
            textured[(c.y as usize - border) / TEXTURE_CELL * columns + (c.x as usize - border) / TEXTURE_CELL] = true;
        }
        for (cell, _) in textured.iter().enumerate().filter(|(_, has_corner)| !**has_corner) {
            let (x, y) = (border + cell % columns * TEXTURE_CELL, border + cell / columns * TEXTURE_CELL);
            let window = Window {
                columns: x..(x + TEXTURE_CELL).min(image.width - fast::RADIUS),
                rows: y..(y + TEXTURE_CELL).min(image.height - fast::RADIUS),
            };
            find_corners(image, &window, self.threshold_low, &mut corners);
        }
        corners.retain(inside);
        corners
    }
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
