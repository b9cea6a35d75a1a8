//! A tree of bounding boxes over the solids, so that a ray meets only those near it. Built once, split at the median.

use glam::DVec3;

use super::shapes::{Primitive, Ray, larger, smaller};

/// So few solids are not worth another split.
const LEAF_SIZE: usize = 2;
/// Deeper than any median-split tree over `u32::MAX` solids.
const MAX_DEPTH: usize = 34;

struct Node {
    low: DVec3,
    high: DVec3,
    /// Leaf: first of its solids in `order`; branch: index of its second child (the first follows it).
    first: u32,
    /// 0 for a branch.
    count: u32,
    /// Axis along which a branch was split.
    axis: u8,
}

/// The tree; solid 0 (the room's shell) is outside it and always tested.
pub struct Bvh {
    nodes: Vec<Node>,
    order: Vec<u32>,
}

impl Bvh {
    /// Over all solids but the first.
    pub fn new(primitives: &[Primitive]) -> Self {
        let bounds: Vec<(DVec3, DVec3)> = primitives.iter().map(Primitive::bounds).collect();
        let mut order: Vec<u32> = (1..primitives.len() as u32).collect();
        let mut nodes = Vec::new();
        let count = order.len();
        if count > 0 {
            split(&bounds, &mut order, 0, &mut nodes);
        }
        Self { nodes, order }
    }

    /// The nearest hit within `0..limit`: its distance in units of the ray's direction, and the solid.
    pub fn nearest(&self, primitives: &[Primitive], ray: &Ray, limit: f64) -> Option<(f64, u32)> {
        let mut best = (limit, u32::MAX);
        self.walk(
            ray,
            |index, t_max| {
                if let Some(t) = primitives[index as usize].intersect(ray).filter(|t| *t < t_max) {
                    best = (t, index);
                }
                Some(best.0)
            },
            limit,
        );
        (best.1 != u32::MAX).then_some(best)
    }

    /// Whether anything lies within `0..limit` of the ray.
    pub fn blocked(&self, primitives: &[Primitive], ray: &Ray, limit: f64) -> bool {
        let mut hit = false;
        self.walk(
            ray,
            |index, t_max| {
                hit = primitives[index as usize].intersect(ray).is_some_and(|t| t < t_max);
                (!hit).then_some(t_max)
            },
            limit,
        );
        hit
    }

    /// Visits the solids near the ray, nearer boxes first; `visit` returns the new limit, or `None` to stop.
    #[inline]
    fn walk(&self, ray: &Ray, mut visit: impl FnMut(u32, f64) -> Option<f64>, mut limit: f64) {
        if self.nodes.is_empty() {
            return;
        }
        let inverse = ray.direction.recip();
        let mut stack = [0u32; MAX_DEPTH];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            let (a, b) = ((node.low - ray.origin) * inverse, (node.high - ray.origin) * inverse);
            let (near, far) = (
                larger(larger(smaller(a.x, b.x), smaller(a.y, b.y)), smaller(a.z, b.z)),
                smaller(smaller(larger(a.x, b.x), larger(a.y, b.y)), larger(a.z, b.z)),
            );
            if near > far || far < 0.0 || near > limit {
                continue;
            }
            if node.count > 0 {
                for solid in &self.order[node.first as usize..(node.first + node.count) as usize] {
                    match visit(*solid, limit) {
                        Some(new_limit) => limit = new_limit,
                        None => return,
                    }
                }
            } else {
                let second_first = ray.direction[usize::from(node.axis)] < 0.0;
                let (near_child, far_child) = if second_first { (node.first, index + 1) } else { (index + 1, node.first) };
                stack[depth] = far_child;
                stack[depth + 1] = near_child;
                depth += 2;
            }
        }
    }
}

/// Appends the tree over `order` (a slice that starts at `offset` of the whole) to `nodes`.
fn split(bounds: &[(DVec3, DVec3)], order: &mut [u32], offset: u32, nodes: &mut Vec<Node>) {
    let of = |i: &u32| bounds[*i as usize];
    let low = order.iter().map(|i| of(i).0).fold(DVec3::INFINITY, DVec3::min);
    let high = order.iter().map(|i| of(i).1).fold(DVec3::NEG_INFINITY, DVec3::max);
    let this = nodes.len();
    nodes.push(Node { low, high, first: offset, count: order.len() as u32, axis: 0 });
    if order.len() <= LEAF_SIZE {
        return;
    }
    let middle = |i: &u32| of(i).0 + of(i).1;
    let spread = order.iter().map(middle).fold(DVec3::NEG_INFINITY, DVec3::max)
        - order.iter().map(middle).fold(DVec3::INFINITY, DVec3::min);
    let axis = if spread.x >= spread.y && spread.x >= spread.z {
        0
    } else if spread.y >= spread.z {
        1
    } else {
        2
    };
    order.sort_by(|a, b| middle(a)[axis].total_cmp(&middle(b)[axis]).then(a.cmp(b)));
    let half = order.len() / 2;
    let (left, right) = order.split_at_mut(half);
    split(bounds, left, offset, nodes);
    let second = nodes.len() as u32;
    split(bounds, right, offset + half as u32, nodes);
    nodes[this] = Node { low, high, first: second, count: 0, axis: axis as u8 };
}
