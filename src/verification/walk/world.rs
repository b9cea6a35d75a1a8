//! The halls of a world and the points on their walls.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};

use super::path::{Crossing, RING};
use super::{Scale, World};
use crate::geometry::Se3;
use crate::tracking::features::descriptor::Descriptor;

/// Share of the points that look like one of a few others.
const REPEATED: f64 = 0.15;
const REPEATS: usize = 40;
/// Cosine of the angle to a wall's normal from which on its points are found.
const MIN_COSINE: f64 = 0.17;
/// Distance between the samples of a line of sight, as a share of half the hall's width.
const SAMPLE: f64 = 0.3;
/// Distance at which a point is as large as the finest pyramid level, as a share of the sight.
const FINEST_AT: std::ops::Range<f64> = 0.12..1.5;

/// A hall between a crossing and the next along x or z.
type Edge = (Crossing, bool);

/// A point of a wall.
#[derive(Clone, Copy, Debug)]
pub struct SeenPoint {
    pub position: Point3<f64>,
    normal: Vector3<f64>,
    /// Distance up to which it is found, at the finest pyramid level.
    pub finest_at_metres: f64,
    pub descriptor: Descriptor,
    /// Of the points in view, the strongest are found.
    pub strength: f64,
}

/// The halls that were visited.
#[derive(Debug)]
pub struct Halls {
    world: World,
    scale: Scale,
    seed: u64,
    repeated: Vec<Descriptor>,
    known: BTreeMap<Edge, Vec<SeenPoint>>,
}

impl Halls {
    pub fn new(world: World, seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x7265_7065);
        let repeated = (0..REPEATS).map(|_| random_descriptor(&mut random)).collect();
        Self { world, scale: world.scale(), seed, repeated, known: BTreeMap::new() }
    }

    /// Points in sight of a camera: near enough, before it, and with no wall between.
    pub fn visible_from(&mut self, world_from_camera: &Se3) -> Vec<SeenPoint> {
        let centre = Point3::from(world_from_camera.translation.vector);
        let ahead = world_from_camera.rotation * Vector3::z();
        let cell = |v: f64| (v / self.scale.edge).floor() as i64;
        let reach = (self.scale.sight / self.scale.edge).ceil() as i64;
        let (x0, z0) = (cell(centre.x), cell(centre.z));
        let around = (x0 - reach..=x0 + reach + 1).flat_map(|x| (z0 - reach..=z0 + reach + 1).map(move |z| (x, z)));
        let edges: Vec<Edge> = around.flat_map(|c| [(c, false), (c, true)]).filter(|e| self.is_open(*e)).collect();
        let mut visible = Vec::new();
        for edge in edges {
            if !self.known.contains_key(&edge) {
                let points = self.furnish(edge);
                self.known.insert(edge, points);
            }
            for point in &self.known[&edge] {
                let line = point.position - centre;
                let distance = line.norm();
                if distance < self.scale.sight
                    && line.dot(&ahead) > 0.6 * distance
                    && -line.dot(&point.normal) > MIN_COSINE * distance
                    && self.sees(&centre, &point.position)
                {
                    visible.push(*point);
                }
            }
        }
        visible
    }

    fn is_open(&self, ((x, z), along_z): Edge) -> bool {
        let size = self.scale.crossings;
        let (x1, z1) = if along_z { (x, z + 1) } else { (x + 1, z) };
        match self.world {
            World::Corridor => {
                let inside = x >= 0 && z >= 0 && x1 <= RING && z1 <= RING;
                inside && if along_z { x == 0 || x == RING } else { z == 0 || z == RING }
            }
            _ => x >= 0 && z >= 0 && x1 < size && z1 < size,
        }
    }

    /// Whether a place is within a hall.
    fn is_free(&self, x: f64, z: f64) -> bool {
        let Scale { edge, half_width, .. } = self.scale;
        let within = |across: f64, along: f64, along_z: bool| {
            let line = (across / edge).round();
            let section = (along / edge).floor();
            let crossing = |section: f64| if along_z { (line as i64, section as i64) } else { (section as i64, line as i64) };
            let open = |section: f64| self.is_open((crossing(section), along_z));
            // A hall reaches half its width beyond its crossings.
            let beyond = along - section * edge;
            (across - line * edge).abs() <= half_width
                && (open(section)
                    || (beyond <= half_width && open(section - 1.0))
                    || (beyond >= edge - half_width && open(section + 1.0)))
        };
        within(x, z, true) || within(z, x, false)
    }

    fn sees(&self, from: &Point3<f64>, to: &Point3<f64>) -> bool {
        let line = to - from;
        let samples = (line.norm() / (SAMPLE * self.scale.half_width)).ceil();
        // Short of the wall itself.
        (1..samples as usize).all(|k| {
            let at = from + line * (k as f64 / samples);
            self.is_free(at.x, at.z)
        })
    }

    /// The points of a hall, always the same ones.
    fn furnish(&self, edge: Edge) -> Vec<SeenPoint> {
        let ((x, z), along_z) = edge;
        // In the corridor every hall looks like the first.
        let key = if self.world == World::Corridor { 0 } else { ((x as u64) << 33) ^ ((z as u64) << 1) ^ u64::from(along_z) };
        let mut random = fastrand::Rng::with_seed(self.seed ^ key.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let Scale { edge: length, half_width, height, points, sight, .. } = self.scale;
        let mut furnished = Vec::new();
        for _ in 0..(points * length) as usize {
            // Along, across and down in the hall's own frame; y points down.
            let along = length * random.f64();
            let side = if random.bool() { 1.0 } else { -1.0 };
            let (across, down, inwards) = match random.usize(0..8) {
                0 => (half_width * (2.0 * random.f64() - 1.0), 0.0, (0.0, -1.0)),
                1 => (half_width * (2.0 * random.f64() - 1.0), -height, (0.0, 1.0)),
                _ => (side * half_width, -height * random.f64(), (-side, 0.0)),
            };
            let finest_at_metres = sight * FINEST_AT.start * (FINEST_AT.end / FINEST_AT.start).powf(random.f64());
            let fresh = random_descriptor(&mut random);
            let repeated = self.repeated[random.usize(0..REPEATS)];
            let descriptor = if random.f64() < REPEATED { repeated } else { fresh };
            let (x0, z0) = (length * x as f64, length * z as f64);
            let (position, normal) = if along_z {
                (Point3::new(x0 + across, down, z0 + along), Vector3::new(inwards.0, inwards.1, 0.0))
            } else {
                (Point3::new(x0 + along, down, z0 + across), Vector3::new(0.0, inwards.1, inwards.0))
            };
            // Where another hall opens there is no wall, and a hall's end has one.
            let behind = position - normal * (0.1 * half_width);
            let is_wall = normal.y != 0.0 || !self.is_free(behind.x, behind.z);
            if is_wall {
                furnished.push(SeenPoint { position, normal, finest_at_metres, descriptor, strength: random.f64() });
            }
        }
        furnished.extend(self.ends(edge, &mut random));
        furnished
    }

    /// Points of the walls that face a hall where it does not go on.
    fn ends(&self, ((x, z), along_z): Edge, random: &mut fastrand::Rng) -> Vec<SeenPoint> {
        let Scale { edge: length, half_width, height, points, sight, .. } = self.scale;
        let mut found = Vec::new();
        for (at, forwards) in [(-half_width, 1.0), (length + half_width, -1.0)] {
            for _ in 0..(points * half_width) as usize {
                let across = half_width * (2.0 * random.f64() - 1.0);
                let down = -height * random.f64();
                let finest_at_metres = sight * FINEST_AT.start * (FINEST_AT.end / FINEST_AT.start).powf(random.f64());
                let descriptor = random_descriptor(random);
                let (x0, z0) = (length * x as f64, length * z as f64);
                let (position, normal) = if along_z {
                    (Point3::new(x0 + across, down, z0 + at), Vector3::new(0.0, 0.0, forwards))
                } else {
                    (Point3::new(x0 + at, down, z0 + across), Vector3::new(forwards, 0.0, 0.0))
                };
                let behind = position - normal * (0.1 * half_width);
                if !self.is_free(behind.x, behind.z) {
                    found.push(SeenPoint { position, normal, finest_at_metres, descriptor, strength: random.f64() });
                }
            }
        }
        found
    }
}

fn random_descriptor(random: &mut fastrand::Rng) -> Descriptor {
    Descriptor(std::array::from_fn(|_| random.u64(..)))
}
