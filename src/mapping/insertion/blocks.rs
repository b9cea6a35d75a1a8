//! Blocks of pixels, small where the colours vary, and what each of them misses.

use image::RgbImage;
use rayon::iter::{IndexedParallelIterator, ParallelIterator};
use rayon::slice::ParallelSliceMut;

use crate::mapping::InsertionConfig;
use crate::optimise::Survey;
use crate::splat::Exposure;

/// Fewer rows of cells are not worth a task of the thread pool.
const ROWS_A_TASK: usize = 16;

/// A square of pixels that gets one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Block {
    pub x: u32,
    pub y: u32,
    pub size: u32,
}

impl Block {
    /// Its middle pixel, on the image; of blocks of more than one cell the first pixel of a cell.
    pub fn center(&self, cell: u32, (width, height): (u32, u32)) -> (u32, u32) {
        let along = |start: u32, pixels: u32| {
            let last = pixels - 1;
            (start + self.size / 2).min(if self.size > cell { last / cell * cell } else { last })
        };
        (along(self.x, width), along(self.y, height))
    }
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
pub(super) struct ColorSums(Sums<u32, 4>);

impl ColorSums {
    pub fn new(image: &RgbImage) -> Self {
        let values = image.as_raw().chunks_exact(3).map(|pixel| {
            let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
            [r, g, b, r * r + g * g + b * b]
        });
        Self(Sums::new(image.dimensions(), values, u32::wrapping_add))
    }

    /// Over a rectangle, from its first corner to before its last, as far as it is on the image; and its pixels.
    fn sums(&self, first: (u32, u32), end: (u32, u32)) -> ([u32; 4], f64) {
        let ([above, beside, below, last], pixels) = self.0.corners(first, end);
        (std::array::from_fn(|k| last[k].wrapping_add(above[k]).wrapping_sub(beside[k]).wrapping_sub(below[k])), pixels)
    }

    /// Blocks that cover the image: quartered while their colours deviate more than noise does, but not below the stride.
    pub fn blocks(&self, config: &InsertionConfig) -> Vec<Block> {
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
        let (sums, pixels) = self.sums((x, y), (x + size, y + size));
        let [r, g, b, squares] = sums.map(|sum| f64::from(sum) / pixels);
        let variance = (squares - (r * r + g * g + b * b)) / 3.0;
        variance.max(0.0).sqrt() as f32 / 255.0
    }
}

/// Brightness residual, image minus render: the sums of cells.
pub(super) struct Missed {
    sums: Sums<f64, 1>,
    cell: u32,
    /// Pixels of the image.
    size: (u32, u32),
}

impl Missed {
    pub fn new(colors: &ColorSums, survey: &Survey, exposure: &Exposure, cell: u32) -> Self {
        let size = (colors.0.width, colors.0.height);
        let factors = exposure.gains().to_array().map(|gain| 1.0 / (3.0 * 255.0 * f64::from(gain)));
        let (columns, rows) = (survey.columns as usize, size.1.div_ceil(cell));
        let mut missed = vec![[0.0]; columns * rows as usize];
        missed.par_chunks_mut(columns).with_min_len(ROWS_A_TASK).enumerate().for_each(|(row, missed)| {
            for (column, to) in missed.iter_mut().enumerate() {
                let (x, y) = (column as u32 * cell, row as u32 * cell);
                let (sums, pixels) = colors.sums((x, y), (x + cell, y + cell));
                let recorded: f64 = (0..3).map(|k| f64::from(sums[k]) * factors[k]).sum();
                *to = [recorded - f64::from(survey.cell(row * columns + column).brightness) * pixels];
            }
        });
        Self { sums: Sums::new((survey.columns, rows), missed.into_iter(), |a, b| a + b), cell, size }
    }

    /// How a block differs from its surroundings in what is missed: the Laplacian of Gaussian at the block's scale, by boxes.
    pub fn response(&self, Block { x, y, size }: Block) -> f32 {
        let mean = |first: (u32, u32), end: (u32, u32)| {
            let in_cells = |(x, y): (u32, u32)| (x / self.cell, y / self.cell);
            let ([[above], [beside], [below], [last]], _) = self.sums.corners(in_cells(first), in_cells(end));
            let pixels = (end.0.min(self.size.0) - first.0) * (end.1.min(self.size.1) - first.1);
            (last + above - beside - below) / f64::from(pixels)
        };
        let around = mean((x.saturating_sub(size), y.saturating_sub(size)), (x + 2 * size, y + 2 * size));
        (mean((x, y), (x + size, y + size)) - around).abs() as f32
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;
    use crate::optimise::SurveyedCell;

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
    fn a_spot_is_missed_and_another_exposure_is_not() {
        let spot = |x: u32, y: u32| (8..10).contains(&x) && (12..14).contains(&y);
        let image = RgbImage::from_fn(33, 25, |x, y| Rgb([if spot(x, y) { 200 } else { 90 }; 3]));
        let exposure = Exposure([1.25f32.ln(); 3]);
        let brightness = 90.0 / 255.0 / 1.25;
        let cells = vec![SurveyedCell { brightness, ..SurveyedCell::default() }; 17 * 13];
        let survey = Survey::of_cells(17, &cells);
        let missed = Missed::new(&ColorSums::new(&image), &survey, &exposure, 2);
        let response = |x, y, size| missed.response(Block { x, y, size });
        let expected = 110.0 / 255.0 / 1.25 * (1.0 - 1.0 / 9.0);
        assert!((response(8, 12, 2) - expected).abs() < 1e-3, "{}", response(8, 12, 2));
        // At the border, too, where cells and blocks are cut off.
        assert!([(0, 0, 2), (20, 12, 4), (32, 24, 4), (32, 24, 2)].into_iter().all(|(x, y, size)| response(x, y, size) < 1e-3));
    }
}
