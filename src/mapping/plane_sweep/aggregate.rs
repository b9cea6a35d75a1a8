//! Semi-global aggregation: along eight directions, a pixel's cost is its own plus that of the best continuation of its predecessor.

use image::GrayImage;

/// Cost of going on at the next plane, and at any other one; the latter falls with the difference in brightness, for there surfaces end.
const NEXT_PLANE: u16 = 4;
const OTHER_PLANE: u16 = 40;
/// Difference in brightness, 0 to 255, at which it has fallen to half.
const EDGE: u16 = 12;

/// Sums over the directions, `[H, W, planes]` as the costs are.
pub(super) fn aggregate(costs: &[u8], gray: &GrayImage, planes: usize) -> Vec<u16> {
    let size = (gray.width() as usize, gray.height() as usize);
    // Four directions each, one scan downwards and one upwards; sums of integers don't depend on their order.
    let (mut down, up) = rayon::join(|| scan(costs, gray, planes, size, false), || scan(costs, gray, planes, size, true));
    down.iter_mut().zip(&up).for_each(|(sum, other)| *sum += other);
    down
}

/// A row's path costs of one direction, `[W, planes]`, and the least of each pixel.
struct Paths {
    costs: Vec<u16>,
    least: Vec<u16>,
}

impl Paths {
    fn new(width: usize, planes: usize) -> Self {
        Self { costs: vec![0; width * planes], least: vec![0; width] }
    }
}

/// From left, upper left, above and upper right; or, backwards, from the four opposite ones.
fn scan(costs: &[u8], gray: &GrayImage, planes: usize, (width, height): (usize, usize), backwards: bool) -> Vec<u16> {
    let mut sums = vec![0u16; costs.len()];
    let pixel = |x: usize, y: usize| if backwards { (height - 1 - y) * width + width - 1 - x } else { y * width + x };
    let mut rows: [Paths; 4] = std::array::from_fn(|_| Paths::new(width, planes));
    let mut last: [Paths; 4] = std::array::from_fn(|_| Paths::new(width, planes));
    for y in 0..height {
        std::mem::swap(&mut rows, &mut last);
        for x in 0..width {
            let i = pixel(x, y);
            let own = &costs[i * planes..(i + 1) * planes];
            let sum = &mut sums[i * planes..(i + 1) * planes];
            let from = [
                (x.wrapping_sub(1), y),
                (x.wrapping_sub(1), y.wrapping_sub(1)),
                (x, y.wrapping_sub(1)),
                (x + 1, y.wrapping_sub(1)),
            ];
            for (direction, (from_x, from_y)) in from.into_iter().enumerate() {
                let to = x * planes..(x + 1) * planes;
                let least = if from_x >= width || from_y >= height {
                    start(own, &mut rows[direction].costs[to], sum)
                } else {
                    let edge = gray.as_raw()[i].abs_diff(gray.as_raw()[pixel(from_x, from_y)]);
                    let other = NEXT_PLANE.max(OTHER_PLANE * EDGE / (EDGE + u16::from(edge)));
                    let at = from_x * planes..(from_x + 1) * planes;
                    // The left neighbour is of this very row.
                    let row = &mut rows[direction];
                    if from_y == y {
                        let (before, after) = row.costs.split_at_mut(to.start);
                        extend(own, &Path { costs: &before[at], least: row.least[from_x] }, other, &mut after[..planes], sum)
                    } else {
                        let last = Path { costs: &last[direction].costs[at], least: last[direction].least[from_x] };
                        extend(own, &last, other, &mut row.costs[to], sum)
                    }
                };
                rows[direction].least[x] = least;
            }
        }
    }
    sums
}

/// A path begins; returns the least of its costs.
fn start(own: &[u8], to: &mut [u16], sum: &mut [u16]) -> u16 {
    let mut least = u16::MAX;
    for ((own, to), sum) in own.iter().zip(to).zip(sum) {
        *to = u16::from(*own);
        *sum += *to;
        least = least.min(*to);
    }
    least
}

/// A path's costs at its last pixel.
struct Path<'a> {
    costs: &'a [u16],
    least: u16,
}

/// Extends a path by one pixel; returns the least of its new costs.
fn extend(own: &[u8], path: &Path<'_>, other: u16, to: &mut [u16], sum: &mut [u16]) -> u16 {
    let Path { costs: last, least: last_least } = *path;
    let jump = last_least + other;
    let planes = own.len();
    let mut least = u16::MAX;
    for k in 0..planes {
        let below = if k > 0 { last[k - 1] + NEXT_PLANE } else { jump };
        let above = if k + 1 < planes { last[k + 1] + NEXT_PLANE } else { jump };
        // What all continuations share is taken off: path costs stay small.
        let cost = u16::from(own[k]) + last[k].min(below).min(above).min(jump) - last_least;
        to[k] = cost;
        sum[k] += cost;
        least = least.min(cost);
    }
    least
}
