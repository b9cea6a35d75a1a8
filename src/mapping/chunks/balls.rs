//! Groups of neighbouring Gaussians, and the balls around them.

use glam::Vec3;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::geometry::Sim3;

/// Gaussians of a group, at most.
const PART: usize = 16;
/// Beyond so many standard deviations, a Gaussian of a group adds little.
const EXTENT: f32 = 1.0;

/// Centre and radius, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(in crate::mapping) struct Ball(pub [f32; 4]);

impl Ball {
    pub fn center(&self) -> Vec3 {
        Vec3::new(self.0[0], self.0[1], self.0[2])
    }

    pub fn radius(&self) -> f32 {
        self.0[3]
    }

    /// Around Gaussians, given their centres and largest standard deviations.
    pub fn around(of: &[(Vec3, f32)]) -> Self {
        Self::around_spheres(of, |(mean, deviation)| (*mean, EXTENT * deviation))
    }

    /// Around other balls.
    pub fn around_balls(of: &[Self]) -> Self {
        Self::around_spheres(of, |ball| (ball.center(), ball.radius()))
    }

    /// Around the middle of the box of all centres, and large enough for each.
    fn around_spheres<T>(of: &[T], sphere: impl Fn(&T) -> (Vec3, f32)) -> Self {
        let (low, high) = bounds(of.iter().map(|one| sphere(one).0));
        let center = 0.5 * (low + high);
        let reach = |(point, radius): (Vec3, f32)| point.distance(center) + radius;
        let radius = of.iter().fold(0.0, |most: f32, one| most.max(reach(sphere(one))));
        // Rounding must not leave anything outside.
        Self([center.x, center.y, center.z, radius * (1.0 + 8.0 * f32::EPSILON)])
    }

    pub fn transform(&mut self, new_from_old: &Sim3) {
        let [x, y, z, radius] = self.0;
        let p = new_from_old.act(&Point3::new(x, y, z).cast());
        self.0 = [p.x as f32, p.y as f32, p.z as f32, radius * new_from_old.scale as f32];
    }
}

/// Gaussians divided into groups, given their centres and largest standard deviations: places of each.
pub(in crate::mapping) fn parts(extents: &[(Vec3, f32)]) -> Vec<Vec<usize>> {
    let mut parts = Vec::new();
    if !extents.is_empty() {
        divide(extents, &mut (0..extents.len()).collect::<Vec<_>>(), &mut parts);
    }
    parts
}

/// Halves a group at the median of its longest side until it is small.
fn divide(of: &[(Vec3, f32)], group: &mut [usize], parts: &mut Vec<Vec<usize>>) {
    if group.len() <= PART {
        parts.push(group.to_vec());
        return;
    }
    let (low, high) = bounds(group.iter().map(|i| of[*i].0));
    let axis = (0..3).max_by(|a, b| (high - low)[*a].total_cmp(&(high - low)[*b])).unwrap_or(0);
    let middle = group.len() / 2;
    group.select_nth_unstable_by(middle, |a, b| of[*a].0[axis].total_cmp(&of[*b].0[axis]).then(a.cmp(b)));
    let (first, second) = group.split_at_mut(middle);
    divide(of, first, parts);
    divide(of, second, parts);
}

fn bounds(points: impl IntoIterator<Item = Vec3>) -> (Vec3, Vec3) {
    points.into_iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), point| (low.min(point), high.max(point)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Se3;

    proptest! {
        #[test]
        fn every_gaussian_is_in_one_small_group_and_in_its_ball(
            points in prop::collection::vec((prop::array::uniform3(-5.0f32..5.0), 0.001f32..0.2), 0..300),
        ) {
            let extents: Vec<(Vec3, f32)> = points.iter().map(|(p, deviation)| (Vec3::from(*p), *deviation)).collect();
            let parts = parts(&extents);
            let mut balls = Vec::new();
            for part in &parts {
                prop_assert!(!part.is_empty() && part.len() <= PART);
                let of_part: Vec<(Vec3, f32)> = part.iter().map(|i| extents[*i]).collect();
                let ball = Ball::around(&of_part);
                let reach = |(p, deviation): &(Vec3, f32)| p.distance(ball.center()) + EXTENT * deviation;
                prop_assert!(of_part.iter().all(|extent| reach(extent) <= ball.radius() * 1.0001));
                balls.push(ball);
            }
            if !balls.is_empty() {
                let all = Ball::around_balls(&balls);
                prop_assert!(balls.iter().all(|b| b.center().distance(all.center()) + b.radius() <= all.radius() * 1.0001));
            }
            let mut places: Vec<usize> = parts.into_iter().flatten().collect();
            places.sort_unstable();
            prop_assert_eq!(places, (0..extents.len()).collect::<Vec<_>>());
        }
    }

    #[test]
    fn balls_move() {
        let mut ball = Ball([1.0, 0.0, 0.0, 0.5]);
        ball.transform(&Sim3 { scale: 2.0, ..Se3::translation(0.0, 3.0, 0.0).into() });
        assert_eq!(ball.0, [2.0, 3.0, 0.0, 1.0]);
    }
}
