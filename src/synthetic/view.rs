//! What one camera pose sees: every solid projected to a rectangle, so that a ray is tried only against those it may meet.
//!
//! Rays start in one point here, so rectangles on the image plane (`z = 1`, before the lens) sort out more than a tree would.

use glam::{DMat3, DVec2, DVec3, dvec3};

use super::light::Scene;
use super::room::{axes, position};
use super::shapes::{Primitive, Ray, Shape};
use crate::geometry::Se3;

/// A solid with a corner nearer to the camera's plane than this is tried everywhere, metres.
const NEAR_METRES: f64 = 0.02;

/// A solid as seen from the camera's centre.
pub struct Projected {
    pub solid: usize,
    shape: Shape,
    outline: Outline,
    /// The camera's centre in the solid's frame.
    pub origin: DVec3,
    pub local_from_camera: DMat3,
}

/// The rectangle around a box as a camera sees it.
#[derive(Clone, Copy)]
pub struct Outline {
    /// Least depth, metres; endless for the room's shell, which is what is left where nothing else is met.
    near: f64,
    far: f64,
    low: DVec2,
    high: DVec2,
}

impl Outline {
    /// A box about `centre` in the camera's frame.
    pub fn of_box(centre: DVec3, camera_from_local: &DMat3, half: DVec3) -> Self {
        let sides = [-1.0, 1.0];
        let corner = |x: f64, y: f64, z: f64| centre + *camera_from_local * (half * dvec3(x, y, z));
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
        Self { near, far, low, high }
    }

    pub fn everything() -> Self {
        Self { near: 0.0, far: f64::INFINITY, low: DVec2::NEG_INFINITY, high: DVec2::INFINITY }
    }

    /// Keeps what lies in `other`, too; false if nothing is left of it before the camera.
    pub fn narrow(&mut self, other: &Self) -> bool {
        (self.low, self.high) = (self.low.max(other.low), self.high.min(other.high));
        other.far > 0.0 && self.low.cmple(self.high).all()
    }
}

/// The solids in front of a camera of all rooms it looks into, nearest first.
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
    pub fn new(world_from_camera: &Se3, scene: &'a Scene, moving: &'a [Primitive]) -> Self {
        let still = &scene.solids;
        let turn = axes(world_from_camera);
        let mut view =
            Self { still, moving, projected: Vec::new(), origin: position(world_from_camera), world_from_camera: turn };
        let rooms = scene.rooms.plan.seen_from(view.origin, &turn);
        let solids = scene.rooms.solids(&rooms).into_iter().map(|solid| solid as usize);
        view.projected = solids.chain(still.len()..still.len() + moving.len()).filter_map(|solid| view.project(solid)).collect();
        view.projected.sort_by(|a, b| a.outline.near.total_cmp(&b.outline.near).then(a.solid.cmp(&b.solid)));
        view
    }

    pub fn solid(&self, index: usize) -> &Primitive {
        if index < self.still.len() { &self.still[index] } else { &self.moving[index - self.still.len()] }
    }

    fn project(&self, index: usize) -> Option<Projected> {
        let solid = self.solid(index);
        let camera_from_local = self.world_from_camera.transpose() * solid.world_from_local;
        let centre = self.world_from_camera.transpose() * (solid.centre - self.origin);
        let mut outline = Outline::of_box(centre, &camera_from_local, solid.shape.half_extent());
        if matches!(solid.shape, Shape::Shell { .. }) {
            outline.near = f64::MAX;
        }
        (outline.far > 0.0).then(|| Projected {
            solid: index,
            shape: solid.shape,
            outline,
            origin: solid.to_local(self.origin),
            local_from_camera: camera_from_local.transpose(),
        })
    }

    /// The items that may be met by rays through a rectangle of the image plane, nearest first.
    pub fn candidates(&self, low: DVec2, high: DVec2, found: &mut Vec<u32>) {
        found.clear();
        let meets = |item: &Projected| item.outline.low.cmple(high).all() && item.outline.high.cmpge(low).all();
        found.extend(self.projected.iter().enumerate().filter(|(_, item)| meets(item)).map(|(k, _)| k as u32));
    }

    /// The first surface along the ray through `n` of the image plane.
    #[inline]
    pub fn first(&self, n: DVec2, candidates: &[u32]) -> Option<Met> {
        let mut best = Met { depth_metres: f64::INFINITY, item: usize::MAX };
        for k in candidates {
            let item = &self.projected[*k as usize];
            let seen = &item.outline;
            if seen.near > best.depth_metres {
                break;
            }
            if n.x < seen.low.x || n.x > seen.high.x || n.y < seen.low.y || n.y > seen.high.y {
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
