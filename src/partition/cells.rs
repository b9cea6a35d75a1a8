//! The cells of a map: the space of its cameras, halved until each part is small enough.
//!
//! Cameras move along the ground, so that borders stand upright: one that lies in a floor or a ceiling would part it into Gaussians of either
//! side at random.

use glam::Vec3;

use super::{FAR, Region};

/// Divides space: the longest side of the cameras' bounding box is halved while it exceeds `size` metres, and a part with more than `most` Gaussian centres is
/// divided at their median. The outermost parts have no end. Parts without centres are left out; the others have each finite centre in exactly one.
pub fn cells(means: &[Vec3], cameras: &[Vec3], limits: (f32, usize), halo: f32) -> Vec<Region> {
    let inside: Vec<Vec3> = means.iter().copied().filter(|mean| mean.is_finite()).collect();
    let mut found = Vec::new();
    let (low, high) = (cameras.iter().copied().reduce(Vec3::min), cameras.iter().copied().reduce(Vec3::max));
    let cell = Part { cameras: low.zip(high).unwrap_or_default(), space: (Vec3::splat(-FAR), Vec3::splat(FAR)) };
    divide(inside, &cell, limits, &mut |low, high| {
        found.push(Region { low: low.to_array(), high: high.to_array(), halo });
    });
    found
}

/// A part of space: its bounds, and those of the cameras' box in it.
#[derive(Clone, Copy)]
struct Part {
    cameras: (Vec3, Vec3),
    space: (Vec3, Vec3),
}

fn divide(inside: Vec<Vec3>, part: &Part, limits: (f32, usize), found: &mut impl FnMut(Vec3, Vec3)) {
    if inside.is_empty() {
        return;
    }
    let ((low, high), (size, most)) = (part.cameras, limits);
    let axis = longest(high - low);
    let border = match (high - low)[axis] > size {
        true => Some((axis, 0.5 * (low[axis] + high[axis]))),
        false => (inside.len() > most).then(|| median(&inside)).flatten(),
    };
    let Some((axis, at)) = border else { return found(part.space.0, part.space.1) };
    let (below, above): (Vec<Vec3>, Vec<Vec3>) = inside.into_iter().partition(|mean| mean[axis] < at);
    // A box beyond the border ends at it.
    let clipped = |corners: (Vec3, Vec3), is_below: bool| {
        let clip = |mut corner: Vec3| {
            corner[axis] = if is_below { corner[axis].min(at) } else { corner[axis].max(at) };
            corner
        };
        (clip(corners.0), clip(corners.1))
    };
    for (inside, is_below) in [(below, true), (above, false)] {
        let part = Part { cameras: clipped(part.cameras, is_below), space: clipped(part.space, is_below) };
        divide(inside, &part, limits, found);
    }
}

fn longest(sides: Vec3) -> usize {
    (0..3).max_by(|&a, &b| sides[a].total_cmp(&sides[b]).then(b.cmp(&a))).unwrap_or(0)
}

/// Axis and place of the median where centres spread most; none where they cannot be divided.
fn median(inside: &[Vec3]) -> Option<(usize, f32)> {
    let mean = inside.iter().copied().sum::<Vec3>() / inside.len() as f32;
    let spread = inside.iter().map(|centre| (*centre - mean) * (*centre - mean)).sum::<Vec3>();
    let axis = longest(spread);
    let mut values: Vec<f32> = inside.iter().map(|centre| centre[axis]).collect();
    let middle = values.len() / 2;
    let at = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
    values.iter().any(|value| *value < at).then_some((axis, at))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::partition::Place;

    fn point() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-30.0f32..30.0).prop_map(Vec3::from)
    }

    fn points() -> impl Strategy<Value = Vec<Vec3>> {
        prop::collection::vec(point(), 1..200)
    }

    proptest! {
        #[test]
        fn every_centre_is_in_one_cell_and_no_cell_is_too_large(means in points(), cameras in points(), size in 3.0f32..20.0) {
            let cells = cells(&means, &cameras, (size, 20), 1.0);
            let count = |region: &Region, all: &[Vec3]| all.iter().filter(|mean| region.place(**mean) == Place::Core).count();
            for mean in &means {
                prop_assert_eq!(cells.iter().filter(|region| region.place(*mean) == Place::Core).count(), 1);
            }
            for region in &cells {
                prop_assert!((1..=20).contains(&count(region, &means)) && region.validate().is_ok());
                let inside: Vec<Vec3> = cameras.iter().copied().filter(|p| region.place(*p) == Place::Core).collect();
                let low = inside.iter().copied().reduce(Vec3::min).unwrap_or_default();
                let high = inside.iter().copied().reduce(Vec3::max).unwrap_or_default();
                prop_assert!((high - low).max_element() <= size * 1.0001);
            }
        }
    }

    #[test]
    fn borders_stand_upright_where_cameras_keep_their_height() {
        let cameras: Vec<Vec3> = (0..40).map(|k| Vec3::new(k as f32, 0.1 * (k % 3) as f32, 0.0)).collect();
        let means: Vec<Vec3> = (0..400).map(|k| Vec3::new((k % 40) as f32, (k / 40) as f32 * 5.0 - 25.0, 3.0)).collect();
        let cells = cells(&means, &cameras, (10.0, usize::MAX), 1.0);
        assert_eq!(cells.len(), 4);
        assert!(cells.iter().all(|region| region.low[1] == -FAR && region.high[1] == FAR), "{cells:?}");
        assert_eq!((cells[0].low[0], cells[0].high[0], cells[3].high[0]), (-FAR, 9.75, FAR));
    }

    #[test]
    fn what_cannot_be_divided_stays_whole() {
        assert_eq!(cells(&[Vec3::ONE; 50], &[Vec3::ZERO], (10.0, 20), 1.0).len(), 1);
        assert_eq!(cells(&[Vec3::ONE], &[], (10.0, 20), 1.0).len(), 1);
        assert!(cells(&[Vec3::NAN], &[Vec3::ZERO], (10.0, 20), 1.0).is_empty());
    }
}
