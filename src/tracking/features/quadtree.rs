//! Choosing corners evenly: the image is split into quarters, largest first, until there are as many parts with a corner as
//! corners are wanted; the strongest of each part stays. (Idea: ORB-SLAM2's quadtree.)

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// A corner at a pyramid level, whole pixels of that level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    pub x: i32,
    pub y: i32,
    pub score: f32,
}

struct Part {
    x0: f64,
    y0: f64,
    width: f64,
    height: f64,
    corners: Vec<Corner>,
}

impl Part {
    fn quarters(self) -> impl Iterator<Item = Self> {
        let (w, h) = (self.width / 2.0, self.height / 2.0);
        let (cx, cy) = (self.x0 + w, self.y0 + h);
        let mut lists: [Vec<Corner>; 4] = Default::default();
        for corner in self.corners {
            lists[usize::from(f64::from(corner.x) >= cx) + 2 * usize::from(f64::from(corner.y) >= cy)].push(corner);
        }
        lists.into_iter().enumerate().filter(|(_, list)| !list.is_empty()).map(move |(k, corners)| Self {
            x0: self.x0 + w * (k % 2) as f64,
            y0: self.y0 + h * (k / 2) as f64,
            width: w,
            height: h,
            corners,
        })
    }

    fn strongest(&self) -> Option<Corner> {
        // On equal scores the last wins, as does the order of detection: deterministic.
        self.corners.iter().copied().max_by(|a, b| a.score.total_cmp(&b.score))
    }
}

/// At most about `budget` of `corners` (up to three more), evenly spread over `width` × `height`.
pub fn distribute(corners: Vec<Corner>, width: i32, height: i32, budget: usize) -> Vec<Corner> {
    if budget == 0 || corners.is_empty() {
        return Vec::new();
    }
    // Square parts spread most evenly.
    let columns = (f64::from(width) / f64::from(height)).round().max(1.0);
    let part_width = f64::from(width) / columns;
    let mut parts: Vec<Option<Part>> = (0..columns as usize)
        .map(|k| {
            let x0 = part_width * k as f64;
            let own = |c: &&Corner| ((f64::from(c.x) / part_width) as usize).min(columns as usize - 1) == k;
            let corners = corners.iter().filter(own).copied().collect();
            Some(Part { x0, y0: 0.0, width: part_width, height: f64::from(height), corners })
        })
        .collect();
    // Largest parts first, then the fullest, then the oldest.
    let mut heap: BinaryHeap<(Reverse<usize>, usize, Reverse<usize>)> = BinaryHeap::new();
    let mut leaves = 0;
    for (index, part) in parts.iter().enumerate() {
        let count = part.as_ref().map_or(0, |p| p.corners.len());
        leaves += usize::from(count > 0);
        if count > 1 {
            heap.push((Reverse(0), count, Reverse(index)));
        }
    }
    while leaves < budget {
        let Some((Reverse(depth), _, Reverse(index))) = heap.pop() else { break };
        let Some(part) = parts[index].take() else { continue };
        if part.width < 1.0 {
            parts[index] = Some(part);
            continue;
        }
        leaves -= 1;
        for quarter in part.quarters() {
            leaves += 1;
            if quarter.corners.len() > 1 {
                heap.push((Reverse(depth + 1), quarter.corners.len(), Reverse(parts.len())));
            }
            parts.push(Some(quarter));
        }
    }
    parts.iter().flatten().filter_map(Part::strongest).collect()
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
