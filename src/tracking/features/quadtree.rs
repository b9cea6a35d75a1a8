//! Choosing corners evenly: the image is split into quarters, largest first, until there are as many parts with a corner as
//! corners are wanted; the strongest of each part stays. (Idea: ORB-SLAM2's quadtree.)

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::ops::Range;

/// A corner at a pyramid level, whole pixels of that level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    pub x: i32,
    pub y: i32,
    pub score: f32,
}

/// A part of the image with the place of its corners in the list.
struct Part {
    x0: f64,
    y0: f64,
    width: f64,
    height: f64,
    corners: Range<usize>,
}

/// Moves the corners of a range so that each quarter's lie together, in their order, and returns where.
fn group(
    corners: &mut [Corner],
    range: &Range<usize>,
    scratch: &mut Vec<Corner>,
    quarter: impl Fn(&Corner) -> usize,
) -> [Range<usize>; 4] {
    scratch.clear();
    scratch.extend_from_slice(&corners[range.clone()]);
    let mut counts = [0; 4];
    scratch.iter().for_each(|c| counts[quarter(c)] += 1);
    let mut end = range.start;
    let groups = counts.map(|count| {
        end += count;
        end - count..end
    });
    let mut places = groups.each_ref().map(|g| g.start);
    for corner in scratch {
        let place = &mut places[quarter(corner)];
        corners[*place] = *corner;
        *place += 1;
    }
    groups
}

impl Part {
    /// Those of its quarters that have corners.
    fn quarters(&self, corners: &mut [Corner], scratch: &mut Vec<Corner>) -> impl Iterator<Item = Self> + use<> {
        let (w, h) = (self.width / 2.0, self.height / 2.0);
        let (x0, y0) = (self.x0, self.y0);
        let (cx, cy) = (x0 + w, y0 + h);
        let quarter = |c: &Corner| usize::from(f64::from(c.x) >= cx) + 2 * usize::from(f64::from(c.y) >= cy);
        let groups = group(corners, &self.corners, scratch, quarter).into_iter().enumerate();
        groups.filter(|(_, corners)| !corners.is_empty()).map(move |(k, corners)| Self {
            x0: x0 + w * (k % 2) as f64,
            y0: y0 + h * (k / 2) as f64,
            width: w,
            height: h,
            corners,
        })
    }
}

/// At most about `budget` of `corners` (up to three more), evenly spread over `width` × `height`.
pub fn distribute(mut corners: Vec<Corner>, width: i32, height: i32, budget: usize) -> Vec<Corner> {
    if budget == 0 || corners.is_empty() {
        return Vec::new();
    }
    // Square parts spread most evenly.
    let columns = (f64::from(width) / f64::from(height)).round().max(1.0);
    let part_width = f64::from(width) / columns;
    let column = |c: &Corner| ((f64::from(c.x) / part_width) as usize).min(columns as usize - 1);
    corners.sort_by_key(column);
    let mut parts: Vec<Part> = Vec::new();
    for own in corners.chunk_by(|a, b| column(a) == column(b)) {
        let start = parts.last().map_or(0, |part| part.corners.end);
        let x0 = part_width * column(&own[0]) as f64;
        parts.push(Part { x0, y0: 0.0, width: part_width, height: f64::from(height), corners: start..start + own.len() });
    }
    // Largest parts first, then the fullest, then the oldest.
    let mut heap: BinaryHeap<(Reverse<usize>, usize, Reverse<usize>)> = BinaryHeap::new();
    let push = |heap: &mut BinaryHeap<_>, depth: usize, index: usize, part: &Part| {
        if part.corners.len() > 1 {
            heap.push((Reverse(depth), part.corners.len(), Reverse(index)));
        }
    };
    parts.iter().enumerate().for_each(|(index, part)| push(&mut heap, 0, index, part));
    let (mut leaves, mut scratch) = (parts.len(), Vec::new());
    while leaves < budget {
        let Some((Reverse(depth), _, Reverse(index))) = heap.pop() else { break };
        if parts[index].width < 1.0 {
            continue;
        }
        leaves -= 1;
        for quarter in parts[index].quarters(&mut corners, &mut scratch) {
            leaves += 1;
            push(&mut heap, depth + 1, parts.len(), &quarter);
            parts.push(quarter);
        }
        // Its quarters have its corners.
        parts[index].corners = 0..0;
    }
    // On equal scores the last wins, as does the order of detection: deterministic.
    let strongest = |part: &Part| corners[part.corners.clone()].iter().copied().max_by(|a, b| a.score.total_cmp(&b.score));
    parts.iter().filter_map(strongest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crowded_corner_of_the_image_does_not_take_all_places() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut corners: Vec<Corner> =
            (0..2000).map(|_| Corner { x: random.i32(0..80), y: random.i32(0..60), score: 200.0 }).collect();
        corners.extend((0..400).map(|_| Corner { x: random.i32(0..640), y: random.i32(0..480), score: random.f32() * 50.0 }));
        let kept = distribute(corners, 640, 480, 200);
        assert!((200..=203).contains(&kept.len()));
        let crowded = kept.iter().filter(|c| c.x < 80 && c.y < 60).count();
        assert!(crowded < 20, "{crowded} of 200 in 1/64 of the image");
    }

    #[test]
    fn the_strongest_of_each_part_stays() {
        let corners: Vec<Corner> = (0..100).map(|i| Corner { x: 10 + i % 10, y: 10 + i / 10, score: i as f32 }).collect();
        let kept = distribute(corners.clone(), 64, 64, 1);
        assert_eq!(kept, [corners[99]]);
        assert!(distribute(Vec::new(), 64, 64, 10).is_empty());
        // Corners on one pixel cannot be told apart and must not split for ever.
        assert_eq!(distribute(vec![corners[0]; 5], 64, 64, 10).len(), 1);
    }
}
