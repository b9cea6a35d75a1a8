//! Errors of a mesh against a true surface, by the two protocols in use.
//!
//! NICE-SLAM (Zhu et al. 2022): mean distances between 200,000 points of each surface, and the share of the truth within 5 cm.
//! Tanks and Temples (Knapitsch et al. 2017), as Gaussian-SLAM applies it: precision, recall and F1 at a distance, after small
//! components are gone. Points of a room lie a centimetre apart, which would hide what these shares ask for: their distance is that to the
//! surface itself.

use glam::Vec3;
use nalgebra::Vector3;
use rayon::prelude::*;
use rstar::{AABB, PointDistance, RTree, RTreeObject};
use serde::Serialize;

use super::{Mesh, components};
use crate::geometry::{Sim3, align};

/// Points drawn from each surface, as in NICE-SLAM.
const SAMPLES: usize = 200_000;
/// Components of fewer vertices do not count, as in Gaussian-SLAM.
const LEAST_VERTICES: usize = 200;
/// Distances of precision and recall, metres.
const DISTANCES: [f64; 3] = [0.01, 0.02, 0.05];
/// NICE-SLAM's completion ratio, metres.
const COMPLETE_WITHIN: f64 = 0.05;
/// Pairs farther apart are none, metres; as in NICE-SLAM.
const ICP_REACH: f64 = 0.1;
/// Points of the mesh that are aligned.
const ICP_SAMPLES: usize = 50_000;
const ICP_ROUNDS: usize = 50;
/// Aligned, once a round moves no point of a room by more, metres and radians.
const ICP_DONE: f64 = 1e-6;

/// Shares within a distance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SurfaceShare {
    /// The distance, metres.
    pub within_m: f64,
    /// Share of the mesh that is this near to the truth.
    pub precision: f64,
    /// Share of the truth that is this near to the mesh.
    pub recall: f64,
    /// Their harmonic mean.
    pub f1: f64,
}

/// Errors of a surface.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshErrors {
    /// Mean distance from the mesh to the truth, metres.
    pub accuracy_m: f64,
    /// Mean distance from the truth to the mesh, metres.
    pub completion_m: f64,
    /// Share of the truth within 5 cm of the mesh.
    pub completion_ratio: f64,
    /// Without components of fewer than 200 vertices.
    pub shares: Vec<SurfaceShare>,
}

/// Points drawn from a surface, evenly over its area; the same ones each time.
fn sample(mesh: &Mesh, count: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut total = 0.0;
    let ends: Vec<f64> = mesh
        .triangles
        .iter()
        .map(|triangle| {
            total += mesh.triangle_area(triangle);
            total
        })
        .collect();
    if total <= 0.0 {
        return Vec::new();
    }
    let mut rng = fastrand::Rng::with_seed(seed);
    let draw = |_| {
        let at = rng.f64() * total;
        let triangle = ends.partition_point(|end| *end <= at).min(ends.len() - 1);
        let [a, b, c] = mesh.triangles[triangle].map(|i| mesh.vertices[i as usize]);
        let (s, t) = (rng.f32(), rng.f32());
        let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
        (a + s * (b - a) + t * (c - a)).to_array()
    };
    (0..count).map(draw).collect()
}

/// A triangle in a tree of them.
struct Facet([Vec3; 3]);

impl Facet {
    /// The point of the triangle that is nearest to `p`: by the region of the triangle's plane that `p` lies over.
    fn nearest(&self, p: Vec3) -> Vec3 {
        let [a, b, c] = self.0;
        let (ab, ac) = (b - a, c - a);
        let normal = ab.cross(ac);
        let squared = normal.length_squared();
        if squared > 0.0 {
            let (v, w) = (normal.dot((p - a).cross(ac)) / squared, normal.dot(ab.cross(p - a)) / squared);
            if v >= 0.0 && w >= 0.0 && v + w <= 1.0 {
                return a + v * ab + w * ac;
            }
        }
        let sides = [(a, b), (b, c), (c, a)].map(|(from, to)| {
            let along = to - from;
            let share = (p - from).dot(along) / along.length_squared().max(f32::MIN_POSITIVE);
            from + share.clamp(0.0, 1.0) * along
        });
        sides.into_iter().min_by(|s, t| s.distance_squared(p).total_cmp(&t.distance_squared(p))).expect("three sides")
    }
}

impl RTreeObject for Facet {
    type Envelope = AABB<[f32; 3]>;

    fn envelope(&self) -> Self::Envelope {
        let [a, b, c] = self.0;
        AABB::from_corners(a.min(b).min(c).to_array(), a.max(b).max(c).to_array())
    }
}

impl PointDistance for Facet {
    fn distance_2(&self, point: &[f32; 3]) -> f32 {
        let p = Vec3::from(*point);
        self.nearest(p).distance_squared(p)
    }
}

fn facets(mesh: &Mesh) -> RTree<Facet> {
    RTree::bulk_load(mesh.triangles.iter().map(|corners| Facet(corners.map(|i| mesh.vertices[i as usize]))).collect())
}

/// Distance of each point to the nearest of the tree, metres.
fn to_points(points: &[[f32; 3]], tree: &RTree<[f32; 3]>) -> Vec<f64> {
    let nearest =
        |p: &[f32; 3]| tree.nearest_neighbor(p).map_or(f64::INFINITY, |q| f64::from(Vec3::from(*p).distance(Vec3::from(*q))));
    points.par_iter().map(nearest).collect()
}

/// Distance of each point to the surface, metres.
fn to_surface(points: &[[f32; 3]], tree: &RTree<Facet>) -> Vec<f64> {
    let nearest = |p: &[f32; 3]| tree.nearest_neighbor(p).map_or(f64::INFINITY, |facet| f64::from(facet.distance_2(p).sqrt()));
    points.par_iter().map(nearest).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn share_within(values: &[f64], distance: f64) -> f64 {
    values.iter().filter(|value| **value < distance).count() as f64 / values.len().max(1) as f64
}

/// Compares a mesh with the truth, in the truth's world; `None` if one of them has no area.
pub fn compare(mesh: &Mesh, truth: &Mesh) -> Option<MeshErrors> {
    let (points, true_points) = (sample(mesh, SAMPLES, 2), sample(truth, SAMPLES, 1));
    if points.is_empty() || true_points.is_empty() {
        return None;
    }
    let accuracy = to_points(&points, &RTree::bulk_load(true_points.clone()));
    let completion = to_points(&true_points, &RTree::bulk_load(points));
    let large = components::keep_larger(mesh.clone(), LEAST_VERTICES);
    let to_truth = to_surface(&sample(&large, SAMPLES, 2), &facets(truth));
    let from_truth = to_surface(&true_points, &facets(&large));
    let shares = DISTANCES.map(|within_m| {
        let (precision, recall) = (share_within(&to_truth, within_m), share_within(&from_truth, within_m));
        let sum = precision + recall;
        SurfaceShare { within_m, precision, recall, f1: if sum > 0.0 { 2.0 * precision * recall / sum } else { 0.0 } }
    });
    Some(MeshErrors {
        accuracy_m: mean(&accuracy),
        completion_m: mean(&completion),
        completion_ratio: share_within(&completion, COMPLETE_WITHIN),
        shares: shares.into(),
    })
}

/// The rigid motion that brings the mesh closest to the truth: ICP (Besl & McKay 1992), with the nearest points of the surface within 10 cm.
pub fn refine_alignment(mesh: &Mesh, truth: &Mesh) -> Sim3 {
    let points = sample(mesh, ICP_SAMPLES, 3);
    let tree = facets(truth);
    let mut motion = Sim3::identity();
    for _ in 0..ICP_ROUNDS {
        let pair = |p: &[f32; 3]| {
            let moved = motion.act(&nalgebra::Point3::from(p.map(f64::from)));
            let at = Vec3::new(moved.x as f32, moved.y as f32, moved.z as f32);
            let near = tree.nearest_neighbor(&at.to_array())?.nearest(at);
            let near = Vector3::from(near.to_array().map(f64::from));
            ((near - moved.coords).norm() < ICP_REACH).then_some((moved.coords, near))
        };
        let (from, to): (Vec<_>, Vec<_>) = points.par_iter().filter_map(pair).unzip();
        let Some(step) = align(&from, &to, false) else { break };
        motion = step * motion;
        if step.translation.norm() + step.rotation.angle() < ICP_DONE {
            break;
        }
    }
    motion
}

impl Mesh {
    /// The mesh moved by a similarity.
    pub fn moved(mut self, motion: &Sim3) -> Self {
        for vertex in &mut self.vertices {
            let p = motion.act(&nalgebra::Point3::from(vertex.to_array().map(f64::from)));
            *vertex = Vec3::new(p.x as f32, p.y as f32, p.z as f32);
        }
        self
    }
}
