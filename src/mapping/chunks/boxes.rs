//! Groups of neighbouring Gaussians, and the boxes around them. Neighbours mostly lie on one surface: a box along it does not reach through the wall behind.

use glam::Vec3;
use nalgebra::{Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::Sim3;
use crate::render::Extent;

/// Gaussians of a group, at most.
const PART: usize = 16;
/// Beyond so many standard deviations, a Gaussian of a group adds little.
const DEVIATIONS: f32 = 2.0;

/// An oriented box: its centre and its half axes, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(in crate::mapping) struct OrientedBox([[f32; 3]; 4]);

impl OrientedBox {
    /// A box of this centre and these half axes, perpendicular to each other.
    pub fn new(center: Vec3, half_axes: [Vec3; 3]) -> Self {
        let [first, second, third] = half_axes.map(|axis| axis.to_array());
        Self([center.to_array(), first, second, third])
    }

    #[cfg(test)]
    pub fn cube(center: Vec3, half: f32) -> Self {
        Self::new(center, [half * Vec3::X, half * Vec3::Y, half * Vec3::Z])
    }

    pub fn center(&self) -> Vec3 {
        self.0[0].into()
    }

    pub fn half_axes(&self) -> [Vec3; 3] {
        [self.0[1], self.0[2], self.0[3]].map(Vec3::from)
    }

    /// How far it reaches from its centre along a unit vector.
    pub fn reach(&self, along: Vec3) -> f32 {
        self.half_axes().iter().map(|axis| axis.dot(along).abs()).sum()
    }

    /// Around Gaussians, along the axes of their common covariance.
    pub fn around(of: &[Extent]) -> Self {
        let share = 1.0 / of.len().max(1) as f32;
        let middle = of.iter().map(|extent| extent.mean * share).sum::<Vec3>();
        let mut covariance = Matrix3::zeros();
        for extent in of {
            for spread in extent.axes.into_iter().chain([extent.mean - middle]) {
                let spread = Vector3::from(spread.to_array()).cast::<f64>();
                covariance += spread * spread.transpose();
            }
        }
        let axes = covariance.symmetric_eigen().eigenvectors.cast::<f32>();
        let axes = [0, 1, 2].map(|axis| Vec3::new(axes[(0, axis)], axes[(1, axis)], axes[(2, axis)]));
        Self::along(axes, middle, of, |extent, axis| (extent.mean, DEVIATIONS * extent.deviation(axis)))
    }

    /// Around other boxes, along the axes of the first.
    pub fn around_boxes(of: &[Self]) -> Self {
        let [first, second, third] = of[0].half_axes().map(Vec3::try_normalize);
        let axes = if let (Some(first), Some(second), Some(third)) = (first, second, third) {
            [first, second, third]
        } else {
            [Vec3::X, Vec3::Y, Vec3::Z]
        };
        Self::along(axes, of[0].center(), of, |one, axis| (one.center(), one.reach(axis)))
    }

    /// Along three axes, and large enough for each: `reach` has its centre and how far it reaches from there along an axis. A point `near` them keeps
    /// rounding errors small.
    fn along<T>(axes: [Vec3; 3], near: Vec3, of: &[T], reach: impl Fn(&T, Vec3) -> (Vec3, f32)) -> Self {
        let mut center = near;
        let half_axes = axes.map(|axis| {
            let ends = of.iter().map(|one| {
                let (middle, reach) = reach(one, axis);
                let middle = (middle - near).dot(axis);
                (middle - reach, middle + reach)
            });
            let (low, high) = ends.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), (a, b)| (low.min(a), high.max(b)));
            center += 0.5 * (low + high) * axis;
            // Rounding must not leave anything outside.
            0.5 * (high - low) * (1.0 + 1e-5) * axis
        });
        Self::new(center, half_axes)
    }

    pub fn transform(&mut self, new_from_old: &Sim3) {
        let turned = |v: Vec3| {
            let v = new_from_old.rotation * Vector3::from(v.to_array()).cast::<f64>() * new_from_old.scale;
            Vec3::new(v.x as f32, v.y as f32, v.z as f32)
        };
        let center = new_from_old.act(&Point3::from(self.0[0]).cast());
        let center = Vec3::new(center.x as f32, center.y as f32, center.z as f32);
        *self = Self::new(center, self.half_axes().map(turned));
    }
}

/// Gaussians divided into groups: places of each.
pub(in crate::mapping) fn parts(extents: &[Extent]) -> Vec<Vec<usize>> {
    let mut parts = Vec::new();
    if !extents.is_empty() {
        divide(extents, &mut (0..extents.len()).collect::<Vec<_>>(), &mut parts);
    }
    parts
}

/// Halves a group at the median of its longest side until it is small.
fn divide(of: &[Extent], group: &mut [usize], parts: &mut Vec<Vec<usize>>) {
    if group.len() <= PART {
        parts.push(group.to_vec());
        return;
    }
    let ends = |(low, high): (Vec3, Vec3), i: &usize| (low.min(of[*i].mean), high.max(of[*i].mean));
    let (low, high) = group.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), ends);
    let axis = (0..3).max_by(|a, b| (high - low)[*a].total_cmp(&(high - low)[*b])).unwrap_or(0);
    let middle = group.len() / 2;
    group.select_nth_unstable_by(middle, |a, b| of[*a].mean[axis].total_cmp(&of[*b].mean[axis]).then(a.cmp(b)));
    let (first, second) = group.split_at_mut(middle);
    divide(of, first, parts);
    divide(of, second, parts);
}

#[cfg(test)]
mod tests {
    use glam::Quat;
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Se3;

    fn extent((mean, scale, [x, y, z]): ([f32; 3], [f32; 3], [f32; 3])) -> Extent {
        Extent::new(mean.into(), Vec3::from(scale), Quat::from_xyzw(x, y, z, 1.0).normalize())
    }

    /// Whether a box reaches as far as a Gaussian does in all directions that its walls face.
    fn holds(bounds: &OrientedBox, extent: &Extent) -> bool {
        let reaches = |half: Vec3| {
            let axis = half.normalize();
            (extent.mean - bounds.center()).dot(axis).abs() + DEVIATIONS * extent.deviation(axis) <= half.length() * 1.001 + 1e-5
        };
        bounds.half_axes().into_iter().all(reaches)
    }

    proptest! {
        #[test]
        fn every_gaussian_is_in_one_small_group_and_in_its_box(
            gaussians in prop::collection::vec(
                (prop::array::uniform3(-5.0f32..5.0), prop::array::uniform3(0.001f32..0.2), prop::array::uniform3(-2.0f32..2.0)), 0..200),
            turn in -3.0f64..3.0,
        ) {
            let extents: Vec<Extent> = gaussians.into_iter().map(extent).collect();
            let parts = parts(&extents);
            let mut boxes = Vec::new();
            for part in &parts {
                prop_assert!(!part.is_empty() && part.len() <= PART);
                let of_part: Vec<Extent> = part.iter().map(|i| extents[*i]).collect();
                let bounds = OrientedBox::around(&of_part);
                prop_assert!(of_part.iter().all(|extent| holds(&bounds, extent)));
                boxes.push((bounds, of_part));
            }
            if !boxes.is_empty() {
                let all = OrientedBox::around_boxes(&boxes.iter().map(|(bounds, _)| *bounds).collect::<Vec<_>>());
                prop_assert!(boxes.iter().flat_map(|(_, part)| part).all(|extent| holds(&all, extent)));
            }
            // A box moves with its Gaussians.
            let motion = Sim3 { scale: 1.5, ..Se3::new([1.0, -2.0, 0.5].into(), [0.0, turn, 0.3].into()).into() };
            for (bounds, of_part) in &mut boxes {
                bounds.transform(&motion);
                for extent in of_part {
                    let turned = |v: Vec3| Vec3::from((motion.rotation.cast() * Vector3::from(v.to_array()) * 1.5).data.0[0]);
                    let mean = motion.act(&Point3::from(extent.mean.to_array()).cast()).cast::<f32>();
                    let moved = Extent { mean: Vec3::from(mean.coords.data.0[0]), axes: extent.axes.map(turned) };
                    prop_assert!(holds(bounds, &moved));
                }
            }
            let mut places: Vec<usize> = parts.into_iter().flatten().collect();
            places.sort_unstable();
            prop_assert_eq!(places, (0..extents.len()).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_box_around_a_wall_is_as_thin_as_the_wall_however_it_is_turned() {
        for turn in [0.0, 0.4, 0.8f32] {
            let along = Quat::from_rotation_y(turn);
            let on_wall = |i: u32| Vec3::new((i % 8) as f32 * 0.2, (i / 8) as f32 * 0.2, 0.0);
            let extents: Vec<Extent> =
                (0..16).map(|i| Extent::new(along * on_wall(i), Vec3::new(0.1, 0.1, 0.01), along)).collect();
            let bounds = OrientedBox::around(&extents);
            assert!((bounds.reach(along * Vec3::Z) - DEVIATIONS * 0.01).abs() < 1e-3, "{bounds:?}");
            assert!((bounds.reach(along * Vec3::X) - (0.7 + DEVIATIONS * 0.1)).abs() < 1e-3, "{bounds:?}");
        }
    }
}
