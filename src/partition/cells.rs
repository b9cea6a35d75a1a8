//! The cells of a map: its bounding box, halved until each part is small enough.

use glam::Vec3;

use super::Region;

/// Divides the space of some centres into boxes: the longest side is halved while it exceeds `size` metres, and a box with more than `most` centres is
/// divided at their median. Boxes without centres are left out. The others have every finite centre in exactly one.
pub fn cells(means: &[Vec3], size: f32, most: usize, halo: f32) -> Vec<Region> {
    let finite: Vec<Vec3> = means.iter().copied().filter(|mean| mean.is_finite()).collect();
    let low = finite.iter().copied().reduce(Vec3::min);
    let high = finite.iter().copied().reduce(Vec3::max);
    let mut found = Vec::new();
    if let (Some(low), Some(high)) = (low, high) {
        // The upper bound belongs to the neighbour, of which there is none.
        let above = high.to_array().map(|v| (v + (v.abs() * 1e-6).max(1e-6)).next_up());
        divide(finite, (low, Vec3::from(above)), (size, most.max(1)), &mut |low, high| {
            found.push(Region { low: low.to_array(), high: high.to_array(), halo });
        });
    }
    found
}

fn divide(inside: Vec<Vec3>, (low, high): (Vec3, Vec3), limits: (f32, usize), found: &mut impl FnMut(Vec3, Vec3)) {
    if inside.is_empty() {
        return;
    }
    let (size, most) = limits;
    let sides = (high - low).to_array();
    let axis = (0..3).max_by(|&a, &b| sides[a].total_cmp(&sides[b]).then(b.cmp(&a))).unwrap_or(0);
    let is_long = sides[axis] > size;
    if !is_long && inside.len() <= most {
        return found(low, high);
    }
    let at = if is_long { 0.5 * (low[axis] + high[axis]) } else { median(&inside, axis) };
    // Many centres in one place cannot be divided.
    if at <= low[axis] || at >= high[axis] {
        return found(low, high);
    }
    let (below, above): (Vec<Vec3>, Vec<Vec3>) = inside.into_iter().partition(|mean| mean[axis] < at);
    let (mut middle_high, mut middle_low) = (high, low);
    (middle_high[axis], middle_low[axis]) = (at, at);
    divide(below, (low, middle_high), limits, found);
    divide(above, (middle_low, high), limits, found);
}

fn median(inside: &[Vec3], axis: usize) -> f32 {
    let mut values: Vec<f32> = inside.iter().map(|mean| mean[axis]).collect();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::partition::Place;

    fn point() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-30.0f32..30.0).prop_map(Vec3::from)
    }

    proptest! {
        #[test]
        fn every_centre_is_in_one_cell_and_no_cell_is_too_large(means in prop::collection::vec(point(), 1..200), size in 3.0f32..20.0) {
            let cells = cells(&means, size, 20, 1.0);
            let of = |region: &Region| means.iter().filter(|mean| region.place(**mean) == Place::Core).count();
            for mean in &means {
                prop_assert_eq!(cells.iter().filter(|region| region.place(*mean) == Place::Core).count(), 1);
            }
            for region in &cells {
                prop_assert!((1..=20).contains(&of(region)));
                prop_assert!((0..3).all(|axis| region.high[axis] - region.low[axis] <= size * 1.0001));
            }
        }
    }

    #[test]
    fn what_cannot_be_divided_stays_whole() {
        let means = vec![Vec3::ONE; 50];
        assert_eq!(cells(&means, 10.0, 20, 1.0).len(), 1);
        assert!(cells(&[Vec3::NAN], 10.0, 20, 1.0).is_empty());
    }
}
