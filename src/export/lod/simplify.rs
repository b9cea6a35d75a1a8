//! A level of detail from the one before: pairs of neighbours whose merging shows least are merged, round by round.
//!
//! What a merge shows is the squared difference of the pair's mixture and the merged Gaussian, in closed form: over the three planes of the axes, in colour
//! and alpha. Left out: what hides a pair.

use glam::Vec3;
use rayon::prelude::*;

use super::merge::{Blob, Footprint, MOST_LOG_SCALE, gaussian, merged, shares};
use crate::splat::{GaussianCloud, sh};

/// Nearest neighbours that a Gaussian may be merged with.
const NEIGHBOURS: usize = 12;
/// Standard deviation of the blur, as a share of the Gaussians' median extent: Gaussians without an area on a plane have one then.
const BLUR: f64 = 0.05;
/// What alpha counts beside a channel of the colour: the background shows where it is wrong.
const ALPHA_WEIGHT: f64 = 0.3;

/// Two Gaussians of a cell, the first before the second, and what merging them shows.
#[derive(Clone, Copy, Debug)]
struct Pair {
    error: f64,
    first: usize,
    second: usize,
}

/// Merges Gaussians of the same cell until `target` are left over all cells, or one a cell.
pub(super) fn simplified(mut cells: Vec<GaussianCloud>, target: usize) -> Vec<GaussianCloud> {
    loop {
        let count: usize = cells.iter().map(GaussianCloud::len).sum();
        let blur = BLUR * median_extent(&cells);
        let found: Vec<Vec<Pair>> = cells.par_iter().map(|cell| pairs(cell, blur)).collect();
        let mut order: Vec<(f64, usize, usize)> = Vec::new();
        for (cell, pairs) in found.iter().enumerate() {
            order.extend(pairs.iter().enumerate().map(|(place, pair)| (pair.error, cell, place)));
        }
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        order.truncate(count.saturating_sub(target));
        if order.is_empty() {
            return cells;
        }
        // Those of a cell are its first ones: they are in the order of their errors.
        let mut chosen = vec![0; cells.len()];
        order.iter().for_each(|(_, cell, _)| chosen[*cell] += 1);
        cells = cells.par_iter().zip(&found).zip(&chosen).map(|((cell, pairs), count)| joined(cell, &pairs[..*count])).collect();
    }
}

/// Median of the Gaussians' middle extents, metres.
pub(super) fn median_extent(cells: &[GaussianCloud]) -> f64 {
    let middle_of = |scale: &Vec3| {
        let mut scales = scale.to_array();
        scales.sort_unstable_by(f32::total_cmp);
        f64::from(scales[1]).clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE)
    };
    let mut extents: Vec<f64> = cells.iter().flat_map(|cell| cell.log_scales.iter().map(middle_of)).collect();
    let middle = extents.len() / 2;
    if extents.is_empty() { 0.0 } else { extents.select_nth_unstable_by(middle, f64::total_cmp).1.exp() }
}

/// The cell with these pairs merged. A merged Gaussian takes the place of the pair's first.
fn joined(cell: &GaussianCloud, pairs: &[Pair]) -> GaussianCloud {
    let mut partner = vec![None; cell.len()];
    let mut is_gone = vec![false; cell.len()];
    for pair in pairs {
        partner[pair.first] = Some(pair.second);
        is_gone[pair.second] = true;
    }
    let mut left = cell.emptied();
    for i in (0..cell.len()).filter(|i| !is_gone[*i]) {
        let Some(k) = partner[i] else {
            left.push(cell.get(i));
            continue;
        };
        let (a, b) = (Blob::new(cell, i), Blob::new(cell, k));
        let (share_a, share_b) = shares(a.mass(), b.mass());
        let mixed = cell.get(i).sh.iter().zip(cell.get(k).sh).map(|(x, y)| *x * share_a as f32 + y * share_b as f32).collect();
        left.push(gaussian(&merged(&a, &b), mixed));
    }
    left
}

/// Disjoint pairs of neighbours, those whose merging shows least first.
fn pairs(cell: &GaussianCloud, blur: f64) -> Vec<Pair> {
    let blobs: Vec<Blob> = (0..cell.len()).map(|i| Blob::new(cell, i)).collect();
    let colors: Vec<Vec<f32>> = cell.sh.chunks(cell.sh_degree.coefficients()).map(color).collect();
    let footprints: Vec<[Footprint; 3]> = blobs.iter().map(|blob| Footprint::blurred(blob, blur)).collect();
    let mut all: Vec<Pair> = Vec::new();
    for first in 0..cell.len() {
        for second in nearest(&cell.means, first).into_iter().filter(|second| *second != usize::MAX) {
            let (i, k) = (first.min(second), first.max(second));
            let error = error([&blobs[i], &blobs[k]], [&footprints[i], &footprints[k]], [&colors[i], &colors[k]], blur);
            all.push(Pair { error, first: i, second: k });
        }
    }
    all.sort_unstable_by(|a, b| a.error.total_cmp(&b.error).then((a.first, a.second).cmp(&(b.first, b.second))));
    let mut is_taken = vec![false; cell.len()];
    all.retain(|pair| {
        let free = !is_taken[pair.first] && !is_taken[pair.second];
        if free {
            (is_taken[pair.first], is_taken[pair.second]) = (true, true);
        }
        free
    });
    all
}

/// Harmonics as a vector whose squared length is the mean square of the colour over all directions.
fn color(harmonics: &[Vec3]) -> Vec<f32> {
    const GREY: f32 = 0.5;
    let constant = harmonics[0] + Vec3::splat(GREY / sh::SH_C0);
    std::iter::once(constant).chain(harmonics[1..].iter().copied()).flat_map(|c| (c * sh::SH_C0).to_array()).collect()
}

/// Indices of the nearest centres; `usize::MAX` where there are fewer.
fn nearest(means: &[Vec3], to: usize) -> [usize; NEIGHBOURS] {
    let mut found = [(f32::INFINITY, usize::MAX); NEIGHBOURS];
    for (i, mean) in means.iter().enumerate() {
        let distance = mean.distance_squared(means[to]);
        if distance < found[NEIGHBOURS - 1].0 && i != to {
            let place = found.partition_point(|(other, _)| *other <= distance);
            found[place..].rotate_right(1);
            found[place] = (distance, i);
        }
    }
    found.map(|(_, i)| i)
}

/// What merging two Gaussians shows.
fn error(blobs: [&Blob; 2], footprints: [&[Footprint; 3]; 2], colors: [&Vec<f32>; 2], blur: f64) -> f64 {
    let both = merged(blobs[0], blobs[1]);
    let (a, b) = shares(blobs[0].mass(), blobs[1].mass());
    let dot = |x: &[f32], y: &[f32]| f64::from(x.iter().zip(y).map(|(x, y)| x * y).sum::<f32>());
    let (aa, ab, bb) = (dot(colors[0], colors[0]), dot(colors[0], colors[1]), dot(colors[1], colors[1]));
    let mixed = [a * aa + b * ab, a * ab + b * bb, a * a * aa + 2.0 * a * b * ab + b * b * bb];
    let of_plane = |plane: usize, both: &Footprint| {
        let (p, q) = (&footprints[0][plane], &footprints[1][plane]);
        p.overlap(p) * (aa + ALPHA_WEIGHT)
            + q.overlap(q) * (bb + ALPHA_WEIGHT)
            + both.overlap(both) * (mixed[2] + ALPHA_WEIGHT)
            + 2.0
                * (p.overlap(q) * (ab + ALPHA_WEIGHT)
                    - p.overlap(both) * (mixed[0] + ALPHA_WEIGHT)
                    - q.overlap(both) * (mixed[1] + ALPHA_WEIGHT))
    };
    Footprint::blurred(&both, blur).iter().enumerate().map(|(plane, both)| of_plane(plane, both)).sum()
}
