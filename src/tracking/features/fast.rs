//! FAST corners (Rosten & Drummond, *Machine learning for high-speed corner detection*, ECCV 2006): nine neighbours of the 16 on a
//! circle around a pixel are all brighter than it by more than a threshold, or all darker.
//!
//! A corner's score is the largest threshold at which it still is one. Scores of [`LANES`] pixels are computed at a time, in the widest vectors
//! of the processor. Corners and scores are OpenCV's.

use std::ops::Range;

use pulp::{Arch, Simd};

use crate::tracking::features::orb::LevelImage;
use crate::tracking::features::quadtree::Corner;

/// Radius of the circle, pixels.
pub const RADIUS: usize = 3;
/// Offsets of the circle's pixels, columns and rows.
const CIRCLE: [(isize, isize); 16] = [
    (0, 3),
    (1, 3),
    (2, 2),
    (3, 1),
    (3, 0),
    (3, -1),
    (2, -2),
    (1, -3),
    (0, -3),
    (-1, -3),
    (-2, -2),
    (-3, -1),
    (-3, 0),
    (-3, 1),
    (-2, 2),
    (-1, 3),
];
const LANES: usize = 32;

/// Part of an image, at least [`RADIUS`] pixels from its border.
#[derive(Clone, Debug)]
pub struct Window {
    pub columns: Range<usize>,
    pub rows: Range<usize>,
}

/// Adds the corners in a window of an image, row by row: the pixels whose score is above that of their eight neighbours in the window. The image is
/// at least 38 pixels wide.
#[pulp::with_simd(find_corners = Arch::new())]
#[inline(always)]
pub fn find_corners_with<'a, S: Simd>(
    _: S,
    image: &'a LevelImage<'a>,
    window: &'a Window,
    threshold: u8,
    found: &'a mut Vec<Corner>,
) {
    let Window { columns, rows } = window;
    let search = Search { image, columns, threshold };
    // A column and a row of zeros on each side: every pixel has eight neighbours. All vectors are whole.
    let row_bytes = columns.len().next_multiple_of(LANES) + 2;
    let mut three = [vec![0; row_bytes], vec![0; row_bytes], vec![0; row_bytes]];
    for y in rows.start..=rows.end {
        three.swap(0, 1);
        three.swap(1, 2);
        three[2].fill(0);
        if y < rows.end {
            search.score_row(y, &mut three[2][1..]);
        }
        if y > rows.start {
            add_maxima(&three, columns.start, y - 1, found);
        }
    }
}

struct Search<'a> {
    image: &'a LevelImage<'a>,
    columns: &'a Range<usize>,
    threshold: u8,
}

impl Search<'_> {
    /// Scores of a row of the window; 0 is no corner.
    #[inline(always)]
    fn score_row(&self, y: usize, row: &mut [u8]) {
        let columns = self.columns;
        for x in columns.clone().step_by(LANES) {
            // All lanes lie in the image.
            let start = x.min(self.image.width - RADIUS - LANES);
            let Some(scores) = self.scores(y * self.image.width + start) else { continue };
            let (row, count) = (&mut row[x - columns.start..], LANES.min(columns.end - x));
            match row.first_chunk_mut() {
                Some(row) if count == LANES => *row = scores,
                _ => row[..count].copy_from_slice(&scores[x - start..][..count]),
            }
        }
    }

    /// Scores of the pixels from `first` on; `None` if none is a corner.
    #[inline(always)]
    fn scores(&self, first: usize) -> Option<[u8; LANES]> {
        let here = lanes(self.image.pixels, first);
        let mut circle = [here; 16];
        for (lane, (x, y)) in circle.iter_mut().zip(CIRCLE) {
            *lane = lanes(self.image.pixels, first.wrapping_add_signed(y * self.image.width as isize + x));
        }
        let mut highest = 0;
        for l in 0..LANES {
            highest = highest.max(bound(here[l], circle[0][l], circle[4][l], circle[8][l], circle[12][l]));
        }
        if highest <= self.threshold {
            return None;
        }
        let mut scores = [0; LANES];
        for l in 0..LANES {
            let mut around = [0; 16];
            for k in 0..16 {
                around[k] = circle[k][l];
            }
            let brighter = best_arc(&around, u8::min, u8::max).saturating_sub(here[l]);
            let darker = here[l].saturating_sub(best_arc(&around, u8::max, u8::min));
            let contrast = brighter.max(darker);
            scores[l] = if contrast > self.threshold { contrast } else { 0 };
        }
        Some(scores)
    }
}

#[inline(always)]
fn lanes(pixels: &[u8], first: usize) -> &[u8; LANES] {
    pixels[first..].first_chunk().expect("a window inside the image")
}

/// Nine neighbours in a row hold two of the four quarters that are next to each other: no arc has more contrast than this.
#[inline(always)]
fn bound(here: u8, north: u8, east: u8, south: u8, west: u8) -> u8 {
    let brighter = north.max(south).min(east.max(west)).saturating_sub(here);
    let darker = here.saturating_sub(north.min(south).max(east.min(west)));
    brighter.max(darker)
}

/// The best of the 16 arcs of nine by their least values.
#[inline(always)]
fn best_arc(around: &[u8; 16], least: impl Fn(u8, u8) -> u8, best: impl Fn(u8, u8) -> u8) -> u8 {
    // Arcs of eight that start at odd places: one more pixel at either end makes two of nine.
    let (mut of_two, mut of_four) = ([0; 8], [0; 8]);
    for k in 0..8 {
        of_two[k] = least(around[2 * k + 1], around[(2 * k + 2) % 16]);
    }
    for k in 0..8 {
        of_four[k] = least(of_two[k], of_two[(k + 1) % 8]);
    }
    let of_nine = |k: usize| least(least(of_four[k], of_four[(k + 2) % 8]), best(around[2 * k], around[(2 * k + 9) % 16]));
    let mut found = of_nine(0);
    for k in 1..8 {
        found = best(found, of_nine(k));
    }
    found
}

/// Adds the maxima of the middle of three rows of scores, which begin a column before `first_column`.
#[inline(always)]
fn add_maxima(three: &[Vec<u8>; 3], first_column: usize, y: usize, found: &mut Vec<Corner>) {
    let [above, row, below] = three;
    for x in (0..row.len() - 2).step_by(LANES) {
        let scores = lanes(row, x + 1);
        if *scores == [0; LANES] {
            continue;
        }
        let [a0, a1, a2] = [0, 1, 2].map(|k| lanes(above, x + k));
        let [b0, b1, b2] = [0, 1, 2].map(|k| lanes(below, x + k));
        let (before, after) = (lanes(row, x), lanes(row, x + 2));
        let mut maxima = [0; LANES];
        for l in 0..LANES {
            let around = a0[l].max(a1[l]).max(a2[l]).max(b0[l]).max(b1[l]).max(b2[l]).max(before[l]).max(after[l]);
            maxima[l] = if around < scores[l] { scores[l] } else { 0 };
        }
        let (words, _) = maxima.as_chunks::<8>();
        for (word, eight) in words.iter().enumerate().filter(|(_, eight)| u64::from_ne_bytes(**eight) != 0) {
            for (k, score) in (8 * word..).zip(eight).filter(|(_, score)| **score > 0) {
                found.push(Corner { x: (first_column + x + k) as i32, y: y as i32, score: f32::from(*score - 1) });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use opencv::core::{KeyPoint, KeyPointTraitConst, Mat, Vector};

    use super::*;

    /// OpenCV's corners.
    fn expected(image: &LevelImage<'_>, threshold: u8) -> Vec<Corner> {
        let mat = Mat::new_rows_cols_with_data(image.height as i32, image.width as i32, image.pixels).unwrap();
        let mut found: Vector<KeyPoint> = Vector::new();
        opencv::features2d::fast(&mat, &mut found, threshold.into(), true).unwrap();
        found.iter().map(|k| Corner { x: k.pt().x as i32, y: k.pt().y as i32, score: k.response() }).collect()
    }

    #[test]
    fn corners_are_those_of_opencv() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut total = 0;
        for (width, height) in [(LANES + 2 * RADIUS, 40), (97, 60), (200, 33)] {
            let noise: Vec<u8> = (0..width * height).map(|_| random.u8(..)).collect();
            // Blocks of a few levels, the darkest and the brightest among them: equal scores, and contrast in all directions.
            let levels = [0, 40, 41, 90, 255];
            let tiles: Vec<u8> = (0..width * height).map(|i| levels[(i % width / 5 * 7 + i / width / 4 * 3) % 5]).collect();
            let soft: Vec<u8> = (0..noise.len()).map(|i| (noise[i] / 8).saturating_add(tiles[i] / 3)).collect();
            for pixels in [&noise, &tiles, &soft] {
                let image = LevelImage { pixels, width, height };
                let window = Window { columns: RADIUS..width - RADIUS, rows: RADIUS..height - RADIUS };
                for threshold in [1, 7, 20, 60, 254] {
                    let mut found = Vec::new();
                    find_corners(&image, &window, threshold, &mut found);
                    assert_eq!(found, expected(&image, threshold), "{width} by {height}, threshold {threshold}");
                    total += found.len();
                }
            }
        }
        assert!(total > 1000, "{total}");
    }

    #[test]
    fn nothing_outside_of_the_window_counts() {
        let mut random = fastrand::Rng::with_seed(4);
        let (width, height) = (120, 80);
        let pixels: Vec<u8> = (0..width * height).map(|_| random.u8(..)).collect();
        let image = LevelImage { pixels: &pixels, width, height };
        let window = Window { columns: 71..width - RADIUS, rows: 20..41 };
        let mut found = Vec::new();
        find_corners(&image, &window, 20, &mut found);
        let (x0, y0) = (window.columns.start - RADIUS, window.rows.start - RADIUS);
        let (x1, y1) = (window.columns.end + RADIUS, window.rows.end + RADIUS);
        let part: Vec<u8> = (y0..y1).flat_map(|y| pixels[y * width + x0..y * width + x1].iter().copied()).collect();
        let part = LevelImage { pixels: &part, width: x1 - x0, height: y1 - y0 };
        let moved = |c: &Corner| Corner { x: c.x + x0 as i32, y: c.y + y0 as i32, ..*c };
        assert_eq!(found, expected(&part, 20).iter().map(moved).collect::<Vec<_>>());
        assert!(found.len() > 20);
    }
}
