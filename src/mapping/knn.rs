//! How far points lie from their nearest neighbours: an implicit k-d tree (Bentley 1975), exact, and the same whatever the threads do.

use glam::Vec3;
use rayon::prelude::*;

/// Neighbours that a point's spacing is the mean distance of, as 3DGS has it.
const NEIGHBOURS: usize = 3;

/// Mean distance of each point to its three nearest neighbours, in the points' unit, `[N]`; infinite where there are fewer than four points.
/// The points must be finite.
pub(super) fn spacings(points: &[Vec3]) -> Vec<f32> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    arrange(points, &mut order, 0);
    let spacing = |i: u32| {
        // Squared distances, ascending; the point itself is left out.
        let mut nearest = [f32::INFINITY; NEIGHBOURS];
        search(points, &order, 0, i, &mut nearest);
        nearest.iter().map(|d| d.sqrt()).sum::<f32>() / NEIGHBOURS as f32
    };
    (0..points.len() as u32).into_par_iter().map(spacing).collect()
}

/// Puts the median along the axis of this depth in the middle, and does the same with both halves.
fn arrange(points: &[Vec3], order: &mut [u32], depth: usize) {
    if order.len() < 2 {
        return;
    }
    let middle = order.len() / 2;
    let key = |i: &u32| points[*i as usize][depth % 3];
    order.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
    let (below, rest) = order.split_at_mut(middle);
    arrange(points, below, depth + 1);
    arrange(points, &mut rest[1..], depth + 1);
}

fn search(points: &[Vec3], order: &[u32], depth: usize, of: u32, nearest: &mut [f32; NEIGHBOURS]) {
    if order.is_empty() {
        return;
    }
    let middle = order.len() / 2;
    let (here, other) = (points[of as usize], points[order[middle] as usize]);
    if order[middle] != of {
        let distance = here.distance_squared(other);
        let place = nearest.partition_point(|d| *d <= distance);
        if place < NEIGHBOURS {
            nearest[place..].rotate_right(1);
            nearest[place] = distance;
        }
    }
    let across = here[depth % 3] - other[depth % 3];
    let (below, above) = (&order[..middle], &order[middle + 1..]);
    let (near, far) = if across < 0.0 { (below, above) } else { (above, below) };
    search(points, near, depth + 1, of, nearest);
    if across * across <= nearest[NEIGHBOURS - 1] {
        search(points, far, depth + 1, of, nearest);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spacings_are_those_of_a_search_through_all_points() {
        let mut rng = fastrand::Rng::with_seed(5);
        // Rounded, so that some points coincide and many share a coordinate.
        let mut coordinate = || (rng.f32() * 20.0).round() * 0.1;
        let points: Vec<Vec3> = (0..700).map(|_| Vec3::new(coordinate(), coordinate(), coordinate())).collect();
        let found = spacings(&points);
        for (i, point) in points.iter().enumerate() {
            let others = points.iter().enumerate().filter(|(j, _)| *j != i);
            let mut distances: Vec<f32> = others.map(|(_, other)| point.distance(*other)).collect();
            distances.sort_by(f32::total_cmp);
            let expected = distances[..3].iter().sum::<f32>() / 3.0;
            assert!((found[i] - expected).abs() < 1e-5, "{i}: {} instead of {expected}", found[i]);
        }
        assert!(spacings(&[]).is_empty() && spacings(&points[..3]).iter().all(|s| s.is_infinite()));
    }
}
