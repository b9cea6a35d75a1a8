//! What one camera pose sees: every solid projected to a rectangle, so that a ray is tried only against those it may meet.
//!
//! Rays start in one point here, so rectangles on the image plane (`z = 1`, before the lens) sort out more than a tree would.

use glam::{DMat3, DVec2, DVec3, dvec3};

use super::room::position;
use super::shapes::{Primitive, Ray, Shape};
use crate::geometry::Se3;

/// A solid with a corner nearer to the camera's plane than this is tried everywhere, metres.
const NEAR_METRES: f64 = 0.02;

/// A solid as seen from the camera's centre.
pub struct Projected {
    pub solid: usize,
    shape: Shape,
    /// Least depth of its box, metres; endless for the room's shell, which is what is left where nothing else is met.
    near: f64,
    low: DVec2,
    high: DVec2,
    /// The camera's centre in the solid's frame.
    pub origin: DVec3,
    pub local_from_camera: DMat3,
}

/// All solids in front of a camera, nearest first; those of the scene, then those that move.
pub struct View<'a> {
    still: &'a [Primitive],
    moving: &'a [Primitive],
    pub projected: Vec<Projected>,
    pub origin: DVec3,
    pub world_from_camera: DMat3,
}

/// A ray's first surface.
#[derive(Clone, Copy)]
pub struct Met {
    /// Depth, and distance in units of the ray's direction, whose z is 1 in the camera's frame.
    pub depth_metres: f64,
    /// Index into [`View::projected`].
    pub item: usize,
}

impl<'a> View<'a> {
    pub fn new(world_from_camera: &Se3, still: &'a [Primitive], moving: &'a [Primitive]) -> Self {
        let r = world_from_camera.rotation.to_rotation_matrix();
        let column = |k: usize| dvec3(r[(0, k)], r[(1, k)], r[(2, k)]);
        let turn = DMat3::from_cols(column(0), column(1), column(2));
        let mut view =
            Self { still, moving, projected: Vec::new(), origin: position(world_from_camera), world_from_camera: turn };
        let count = still.len() + moving.len();
        view.projected = (0..count).filter_map(|solid| view.project(solid)).collect();
        view.projected.sort_by(|a, b| a.near.total_cmp(&b.near).then(a.solid.cmp(&b.solid)));
        view
    }

    pub fn solid(&self, index: usize) -> &Primitive {
        if index < self.still.len() { &self.still[index] } else { &self.moving[index - self.still.len()] }
    }

    fn project(&self, index: usize) -> Option<Projected> {
        let solid = self.solid(index);
        let camera_from_local = self.world_from_camera.transpose() * solid.world_from_local;
        let centre = self.world_from_camera.transpose() * (solid.centre - self.origin);
        let half = solid.shape.half_extent();
        let sides = [-1.0, 1.0];
        let corner = |x: f64, y: f64, z: f64| centre + camera_from_local * (half * dvec3(x, y, z));
        let corners = sides.iter().flat_map(|x| sides.iter().flat_map(move |y| sides.map(|z| corner(*x, *y, z))));
        let (mut near, mut far) = (f64::INFINITY, f64::NEG_INFINITY);
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for c in corners {
            (near, far) = (near.min(c.z), far.max(c.z));
            let n = c.truncate() / c.z;
            (low, high) = (low.min(n), high.max(n));
        }
        if near < NEAR_METRES {
            (near, low, high) = (0.0, DVec2::NEG_INFINITY, DVec2::INFINITY);
        }
        if matches!(solid.shape, Shape::Shell { .. }) {
            near = f64::MAX;
        }
        (far > 0.0).then(|| Projected {
            solid: index,
            shape: solid.shape,
            near,
            low,
            high,
            origin: solid.to_local(self.origin),
            local_from_camera: camera_from_local.transpose(),
        })
    }

    /// The items that may be met by rays through a rectangle of the image plane, nearest first.
    pub fn candidates(&self, low: DVec2, high: DVec2, found: &mut Vec<u32>) {
        found.clear();
        let meets = |item: &Projected| item.low.cmple(high).all() && item.high.cmpge(low).all();
        found.extend(self.projected.iter().enumerate().filter(|(_, item)| meets(item)).map(|(k, _)| k as u32));
    }

    /// The first surface along the ray through `n` of the image plane.
    #[inline]
    pub fn first(&self, n: DVec2, candidates: &[u32]) -> Option<Met> {
        let mut best = Met { depth_metres: f64::INFINITY, item: usize::MAX };
        for k in candidates {
            let item = &self.projected[*k as usize];
            if item.near > best.depth_metres {
                break;
            }
            if n.x < item.low.x || n.x > item.high.x || n.y < item.low.y || n.y > item.high.y {
                continue;
            }
            let ray = Ray { origin: item.origin, direction: item.local_from_camera * n.extend(1.0) };
            if let Some(t) = item.shape.intersect(&ray).filter(|t| *t < best.depth_metres) {
                best = Met { depth_metres: t, item: *k as usize };
            }
        }
        (best.item != usize::MAX).then_some(best)
    }
}
