//! Descriptors of corners: each bit compares the brightness of two pixels of a smoothed patch, turned by the corner's angle (Rublee et al., *ORB*, ICCV
//! 2011, sec. 4).
//!
//! The pairs of pixels are OpenCV's, which were learned, and so are the descriptors. OpenCV has no accessor for its pairs: they are read from its
//! descriptors of images with a single bright or dark pixel.

use std::sync::OnceLock;

use opencv::core::{
    BORDER_REFLECT_101, KeyPoint, Mat, MatTrait, MatTraitConst, MatTraitConstManual, Rect, Scalar, Size, StsError, ToInputArray,
    Vector,
};
use opencv::features2d::{self, Feature2DTrait};
use opencv::imgproc;
use pulp::{Arch, Simd};

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::orb::LevelImage;
use crate::tracking::features::orientation::PATCH_RADIUS;
use crate::tracking::features::quadtree::Corner;

/// Pixels around a smoothed image: a turned patch at the border reaches so far outside.
const MARGIN: i32 = 6;
/// Side of the patches that the pattern is read from, pixels; their pairs do not touch.
const TILE: i32 = 48;
const BITS: usize = 256;
/// A turned patch reaches this far from its corner, pixels.
const REACH: i32 = PATCH_RADIUS + MARGIN;
const PATCH_SIDE: usize = 2 * REACH as usize + 1;
/// Stride of a patch's rows. A power of two: the remainder that keeps places inside costs one instruction.
const PATCH_ROW: usize = PATCH_SIDE.next_power_of_two();
const PATCH_CENTRE: usize = (PATCH_ROW + 1) * REACH as usize;

/// Pairs of pixels by their places from the corner, columns and rows: the first pixel of each, then the second.
#[derive(Clone, Debug, PartialEq)]
pub struct SamplingPattern {
    x: [f32; 2 * BITS],
    y: [f32; 2 * BITS],
}

/// An image smoothed for comparisons, with [`MARGIN`] pixels on each side.
#[derive(Debug)]
pub struct SmoothedImage(Mat);

impl SmoothedImage {
    /// Smooths a grey image.
    ///
    /// # Errors
    /// Those of OpenCV.
    pub fn new(image: &(impl ToInputArray + MatTraitConst)) -> Result<Self, opencv::Error> {
        let inside = Rect::new(MARGIN, MARGIN, image.cols(), image.rows());
        let (mut smoothed, mut middle) = (Mat::default(), Mat::default());
        opencv::core::copy_make_border(
            image,
            &mut smoothed,
            MARGIN,
            MARGIN,
            MARGIN,
            MARGIN,
            BORDER_REFLECT_101,
            Scalar::default(),
        )?;
        // OpenCV rounds the pixels of a part of an image otherwise than those of a whole one, and its descriptors are of a part.
        imgproc::gaussian_blur(&smoothed.roi(inside)?, &mut middle, Size::new(7, 7), 2.0, 2.0, BORDER_REFLECT_101)?;
        middle.copy_to(&mut smoothed.roi_mut(inside)?)?;
        Ok(Self(smoothed))
    }
}

impl SamplingPattern {
    /// OpenCV's pattern; read once.
    ///
    /// # Errors
    /// Those of OpenCV, and if its descriptors compare no pairs of pixels.
    pub fn get() -> Result<&'static Self, opencv::Error> {
        static PATTERN: OnceLock<SamplingPattern> = OnceLock::new();
        match PATTERN.get() {
            Some(pattern) => Ok(pattern),
            None => Self::read().map(|pattern| PATTERN.get_or_init(|| pattern)),
        }
    }

    fn read() -> Result<Self, opencv::Error> {
        let (mut pattern, mut found) = (Self { x: [0.0; 2 * BITS], y: [0.0; 2 * BITS] }, [0; 2 * BITS]);
        // A bit says that the first pixel is darker than the second.
        for (background, first) in [(255, 0), (0, BITS)] {
            for (x, y, descriptor) in descriptors_of_single_pixels(background)? {
                for k in (0..BITS).filter(|k| descriptor.bit(*k) == 1) {
                    (pattern.x[first + k], pattern.y[first + k]) = (x as f32, y as f32);
                    found[first + k] += 1;
                }
            }
        }
        let is_whole = found.iter().all(|times| *times == 1);
        is_whole.then_some(pattern).ok_or_else(|| opencv::Error::new(StsError, "ORB's pairs of pixels could not be read"))
    }

    /// Descriptors of corners at least [`PATCH_RADIUS`] + 1 pixels from the image's border, with their angles in radians.
    ///
    /// # Errors
    /// Those of OpenCV.
    pub fn describe(&self, image: &SmoothedImage, corners: &[Corner], angles: &[f32]) -> Result<Vec<Descriptor>, opencv::Error> {
        let SmoothedImage(mat) = image;
        let pixels = LevelImage { pixels: mat.data_bytes()?, width: mat.cols() as usize, height: mat.rows() as usize };
        Ok(describe(self, &pixels, corners, angles))
    }

    /// Places of the turned pairs in a patch.
    #[inline(always)]
    fn turned(&self, angle_rad: f32) -> [u16; 2 * BITS] {
        // A smaller number added to it is rounded to a whole one, halves to even, which the last bits hold.
        const WHOLE: f32 = 12_582_912.0;
        let (sin, cos) = angle_rad.sin_cos();
        let mut places = [0; 2 * BITS];
        for (place, (x, y)) in places.iter_mut().zip(self.x.iter().zip(&self.y)) {
            let column = (x * cos - y * sin + WHOLE) - WHOLE;
            let row = (x * sin + y * cos + WHOLE) - WHOLE;
            *place = (row * PATCH_ROW as f32 + column + (WHOLE + PATCH_CENTRE as f32)).to_bits() as u16;
        }
        places
    }
}

#[pulp::with_simd(describe = Arch::new())]
#[inline(always)]
fn describe_with<'a, S: Simd>(
    _: S,
    pattern: &'a SamplingPattern,
    image: &'a LevelImage<'a>,
    corners: &'a [Corner],
    angles: &'a [f32],
) -> Vec<Descriptor> {
    let mut descriptors = Vec::with_capacity(corners.len());
    let mut patch = [0; PATCH_ROW * PATCH_ROW];
    for (corner, angle_rad) in corners.iter().zip(angles) {
        let first = (corner.y + MARGIN - REACH) as usize * image.width + (corner.x + MARGIN - REACH) as usize;
        for (row, pixels) in patch.chunks_exact_mut(PATCH_ROW).zip(image.pixels[first..].chunks(image.width)).take(PATCH_SIDE) {
            row[..PATCH_SIDE].copy_from_slice(&pixels[..PATCH_SIDE]);
        }
        let mut levels = [0; 2 * BITS];
        for (level, place) in levels.iter_mut().zip(pattern.turned(*angle_rad)) {
            *level = patch[usize::from(place) % patch.len()];
        }
        let (first, second) = levels.split_at(BITS);
        let mut words = [0; BITS / 64];
        for (word, (first, second)) in words.iter_mut().zip(first.chunks_exact(64).zip(second.chunks_exact(64))) {
            for (bit, (first, second)) in first.iter().zip(second).enumerate() {
                *word |= u64::from(first < second) << bit;
            }
        }
        descriptors.push(Descriptor(words));
    }
    descriptors
}

/// OpenCV's descriptors of patches that are of one grey level but for a pixel: its place from the middle, column and row, and the descriptor.
fn descriptors_of_single_pixels(background: u8) -> Result<Vec<(i32, i32, Descriptor)>, opencv::Error> {
    let level = traceable_level(background)?;
    let count = 2 * PATCH_RADIUS + 1;
    let (side, mut keypoints) = (count * TILE, Vector::<KeyPoint>::new());
    let mut pixels = vec![background; (side * side) as usize];
    let places: Vec<(i32, i32)> = (0..count * count).map(|i| (i % count, i / count)).collect();
    for (column, row) in &places {
        let (x, y) = (column * TILE + TILE / 2, row * TILE + TILE / 2);
        pixels[((y + row - PATCH_RADIUS) * side + x + column - PATCH_RADIUS) as usize] = level;
        keypoints.push(KeyPoint::new_coords(x as f32, y as f32, 31.0, 0.0, 0.0, 0, -1)?);
    }
    let found = opencv_descriptors(&Mat::new_rows_cols_with_data(side, side, &pixels)?, keypoints)?;
    let places = places.iter().map(|(column, row)| (column - PATCH_RADIUS, row - PATCH_RADIUS));
    Ok(places.zip(found).map(|((x, y), descriptor)| (x, y, descriptor)).collect())
}

/// A grey level that smoothing leaves a trace of in the pixel that has it, and in no other.
fn traceable_level(background: u8) -> Result<u8, opencv::Error> {
    const MIDDLE: usize = (TILE * TILE + TILE) as usize / 2;
    for contrast in 1..=u8::MAX {
        let mut pixels = vec![background; (TILE * TILE) as usize];
        pixels[MIDDLE] = background.abs_diff(contrast);
        let SmoothedImage(mat) = SmoothedImage::new(&Mat::new_rows_cols_with_data(TILE, TILE, &pixels)?)?;
        let smoothed = mat.data_bytes()?;
        match smoothed.iter().filter(|level| **level != smoothed[0]).count() {
            0 => {}
            1 => return Ok(pixels[MIDDLE]),
            _ => break,
        }
    }
    Err(opencv::Error::new(StsError, "smoothing spreads every grey level"))
}

/// OpenCV's descriptors of keypoints in an image, one for each.
fn opencv_descriptors(image: &impl ToInputArray, mut keypoints: Vector<KeyPoint>) -> Result<Vec<Descriptor>, opencv::Error> {
    let border = PATCH_RADIUS + 1;
    let mut orb =
        features2d::ORB::create(1, 1.2, 1, border, 0, 2, features2d::ORB_ScoreType::FAST_SCORE, 2 * PATCH_RADIUS + 1, 20)?;
    let mut descriptors = Mat::default();
    orb.compute(image, &mut keypoints, &mut descriptors)?;
    (0..descriptors.rows()).map(|row| Ok(Descriptor::from_bytes(descriptors.at_row::<u8>(row)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_those_of_opencv() {
        let mut random = fastrand::Rng::with_seed(12);
        let (width, height) = (150, 110);
        let noise: Vec<u8> = (0..width * height).map(|_| random.u8(..)).collect();
        // Equal neighbours, too.
        let tiles: Vec<u8> =
            (0..width * height).map(|i| [10, 90, 91, 255][(i % width / 7 * 3 + i / width / 5) as usize % 4]).collect();
        for pixels in [noise, tiles] {
            let image = Mat::new_rows_cols_with_data(height, width, &pixels).unwrap();
            let (mut corners, mut angles, mut keypoints) = (Vec::new(), Vec::new(), Vector::<KeyPoint>::new());
            let inside = |length: i32| PATCH_RADIUS + 1..length - PATCH_RADIUS - 1;
            for (x, y) in inside(width).step_by(3).flat_map(|x| inside(height).step_by(2).map(move |y| (x, y))) {
                let angle = random.f32() * std::f32::consts::TAU;
                corners.push(Corner { x, y, score: 0.0 });
                angles.push(angle);
                keypoints.push(KeyPoint::new_coords(x as f32, y as f32, 31.0, angle.to_degrees(), 0.0, 0, -1).unwrap());
            }
            let smoothed = SmoothedImage::new(&image).unwrap();
            let found = SamplingPattern::get().unwrap().describe(&smoothed, &corners, &angles).unwrap();
            let expected = opencv_descriptors(&image, keypoints).unwrap();
            assert_eq!(found.len(), expected.len());
            // Degrees are rounded: a pixel may come to lie beside.
            let bits: u32 = found.iter().zip(&expected).map(|(a, b)| a.distance(b)).sum();
            assert!(found.len() > 1000 && bits as usize <= found.len() * BITS / 100_000, "{bits} of {} descriptors", found.len());
        }
    }
}
