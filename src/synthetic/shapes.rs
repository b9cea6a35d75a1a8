//! Solids the room is made of, and how rays meet them: boxes, cylinders, ellipsoids, and the room itself seen from inside.
//!
//! Every solid is convex and lives in its own frame (z up, origin at its centre), so a ray meets it in one interval. Each face is a
//! *chart*: a rectangle in metres, `u` to the right and `v` up for someone who looks at the face, on which its texture lies. An
//! ellipsoid has six like a box, each the projection along its axis.

use glam::{DMat3, DVec2, DVec3};

use super::texture::Material;

/// Nearer than this (in units of the ray's direction) a ray does not see the surface it starts on.
const MIN_T: f64 = 1e-6;
const TURN: f64 = std::f64::consts::TAU;

/// A half line; `direction` has any length, and hits are counted in its multiples.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    pub origin: DVec3,
    pub direction: DVec3,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    Block {
        half: DVec3,
    },
    /// Upright: its axis is z.
    Cylinder {
        radius: f64,
        half_height: f64,
    },
    Ellipsoid {
        radii: DVec3,
    },
    /// A box seen from inside.
    Shell {
        half: DVec3,
    },
}

/// A solid placed in the world, with what it is made of.
#[derive(Clone, Debug)]
pub struct Primitive {
    pub shape: Shape,
    pub centre: DVec3,
    pub world_from_local: DMat3,
    pub material: Material,
    /// Makes two solids of one material look different.
    pub seed: u32,
}

/// A point of a chart, in the solid's own frame; `normal` and the tangents are of unit length.
#[derive(Clone, Copy, Debug)]
pub struct ChartPoint {
    pub chart: usize,
    /// Metres from the chart's lower left corner.
    pub uv: DVec2,
    pub position: DVec3,
    pub normal: DVec3,
    pub along_u: DVec3,
    pub along_v: DVec3,
}

impl Shape {
    /// Size of each chart in metres.
    pub fn charts(&self) -> Vec<DVec2> {
        match *self {
            Self::Block { half } | Self::Shell { half } | Self::Ellipsoid { radii: half } => {
                (0..6).map(block_axes).map(|(_, u, v)| DVec2::new(half.dot(u.abs()), half.dot(v.abs())) * 2.0).collect()
            }
            Self::Cylinder { radius, half_height } => {
                vec![DVec2::new(TURN * radius, 2.0 * half_height), DVec2::splat(2.0 * radius), DVec2::splat(2.0 * radius)]
            }
        }
    }

    /// Whether the chart's left and right borders are the same line of the surface.
    pub fn wraps(&self, chart: usize) -> bool {
        match self {
            Self::Cylinder { .. } => chart == 0,
            _ => false,
        }
    }

    /// Half the size of the axis-aligned box around the solid, in its own frame.
    pub fn half_extent(&self) -> DVec3 {
        match *self {
            Self::Block { half } | Self::Shell { half } => half,
            Self::Cylinder { radius, half_height } => DVec3::new(radius, radius, half_height),
            Self::Ellipsoid { radii } => radii,
        }
    }

    /// Where a ray in the solid's frame first meets the surface from its visible side.
    #[inline]
    pub fn intersect(&self, ray: &Ray) -> Option<f64> {
        let (near, far) = self.interval(ray.origin, ray.direction)?;
        let t = if matches!(self, Self::Shell { .. }) { far } else { near };
        (t > MIN_T).then_some(t)
    }

    /// The interval of a local ray inside the solid.
    #[inline]
    fn interval(&self, o: DVec3, d: DVec3) -> Option<(f64, f64)> {
        match *self {
            Self::Block { half } | Self::Shell { half } => slabs(o, d, half),
            Self::Cylinder { radius, half_height } => {
                let (z0, z1) = slab(o.z, d.z, half_height);
                let (r0, r1) = ball(o.truncate().extend(0.0), d.truncate().extend(0.0), radius)?;
                let (near, far) = (z0.max(r0), z1.min(r1));
                (near <= far).then_some((near, far))
            }
            Self::Ellipsoid { radii } => ball(o / radii, d / radii, 1.0),
        }
    }

    /// The chart point nearest to a point of the surface, in the solid's frame.
    pub fn chart_point(&self, p: DVec3) -> ChartPoint {
        match *self {
            Self::Block { half } | Self::Shell { half } | Self::Ellipsoid { radii: half } => {
                let r = p / half;
                let a = r.abs();
                let axis = if a.x >= a.y && a.x >= a.z {
                    0
                } else if a.y >= a.z {
                    1
                } else {
                    2
                };
                let chart = axis * 2 + usize::from(r[axis] > 0.0);
                let (mut normal, u, v) = self.block_frame(chart);
                if matches!(self, Self::Ellipsoid { .. }) {
                    normal = (p / (half * half)).normalize();
                }
                let uv = DVec2::new(p.dot(u) + half.dot(u.abs()), p.dot(v) + half.dot(v.abs()));
                ChartPoint { chart, uv, position: p, normal, along_u: u, along_v: v }
            }
            Self::Cylinder { radius, half_height } => {
                let across = p.truncate().length();
                if (across - radius).abs() < (p.z.abs() - half_height).abs() {
                    self.round_point(p, DVec2::new((p.y.atan2(p.x) + TURN / 2.0) * radius, p.z + half_height))
                } else {
                    let up = if p.z > 0.0 { 1.0 } else { -1.0 };
                    let u = DVec3::new(up, 0.0, 0.0);
                    let uv = DVec2::new(p.x * up + radius, p.y + radius);
                    let chart = if p.z > 0.0 { 1 } else { 2 };
                    ChartPoint { chart, uv, position: p, normal: DVec3::Z * up, along_u: u, along_v: DVec3::Y }
                }
            }
        }
    }

    /// The point at `uv` of a chart; the inverse of [`Self::chart_point`].
    pub fn point_at(&self, chart: usize, uv: DVec2) -> ChartPoint {
        match *self {
            Self::Block { half } | Self::Shell { half } => {
                let (outward, ..) = block_axes(chart);
                let (normal, u, v) = self.block_frame(chart);
                let position = outward * half + u * (uv.x - half.dot(u.abs())) + v * (uv.y - half.dot(v.abs()));
                ChartPoint { chart, uv, position, normal, along_u: u, along_v: v }
            }
            Self::Cylinder { radius, half_height } if chart == 0 => {
                let angle = uv.x / radius - TURN / 2.0;
                self.round_point(DVec3::new(angle.cos() * radius, angle.sin() * radius, uv.y - half_height), uv)
            }
            Self::Cylinder { radius, half_height } => {
                let up = if chart == 1 { 1.0 } else { -1.0 };
                let position = DVec3::new((uv.x - radius) * up, uv.y - radius, half_height * up);
                let u = DVec3::new(up, 0.0, 0.0);
                ChartPoint { chart, uv, position, normal: DVec3::Z * up, along_u: u, along_v: DVec3::Y }
            }
            Self::Ellipsoid { radii } => {
                let (outward, u, v) = block_axes(chart);
                let in_plane = u * (uv.x - radii.dot(u.abs())) + v * (uv.y - radii.dot(v.abs()));
                // Corners of the chart that the solid does not reach stand for its rim.
                let across = (in_plane / radii).length();
                let on_ball = in_plane / radii / across.max(1.0) + outward * (1.0 - across * across).max(0.0).sqrt();
                let normal = (on_ball / radii).normalize();
                ChartPoint { chart, uv, position: on_ball * radii, normal, along_u: u, along_v: v }
            }
        }
    }

    /// Normal (towards the viewer), `u` and `v` of a box's face.
    fn block_frame(&self, chart: usize) -> (DVec3, DVec3, DVec3) {
        let (outward, u, v) = block_axes(chart);
        match self {
            Self::Shell { .. } => (-outward, -u, v),
            _ => (outward, u, v),
        }
    }

    /// A point of a cylinder's side.
    fn round_point(&self, position: DVec3, uv: DVec2) -> ChartPoint {
        let normal = DVec3::new(position.x, position.y, 0.0).normalize();
        ChartPoint { chart: 0, uv, position, normal, along_u: DVec3::Z.cross(normal), along_v: DVec3::Z }
    }
}

/// Outward normal, rightward and upward axis of a box's face, seen from outside. `chart` is `2 * axis + (side > 0)`.
fn block_axes(chart: usize) -> (DVec3, DVec3, DVec3) {
    let side = if chart % 2 == 1 { 1.0 } else { -1.0 };
    match chart / 2 {
        0 => (DVec3::X * side, DVec3::Y * side, DVec3::Z),
        1 => (DVec3::Y * side, DVec3::X * -side, DVec3::Z),
        _ => (DVec3::Z * side, DVec3::X * side, DVec3::Y),
    }
}

#[inline]
fn slab(o: f64, d: f64, half: f64) -> (f64, f64) {
    if d == 0.0 {
        return if o.abs() <= half { (f64::NEG_INFINITY, f64::INFINITY) } else { (1.0, -1.0) };
    }
    let inverse = 1.0 / d;
    let (a, b) = ((-half - o) * inverse, (half - o) * inverse);
    if a < b { (a, b) } else { (b, a) }
}

/// `f64::min` and `max` take care of NaN, which costs more than all the rest here.
#[inline]
pub fn smaller(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

#[inline]
pub fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[inline]
fn slabs(o: DVec3, d: DVec3, half: DVec3) -> Option<(f64, f64)> {
    let (x, y, z) = (slab(o.x, d.x, half.x), slab(o.y, d.y, half.y), slab(o.z, d.z, half.z));
    let (near, far) = (larger(larger(x.0, y.0), z.0), smaller(smaller(x.1, y.1), z.1));
    (near <= far).then_some((near, far))
}

/// The interval of a ray inside a ball about the origin (or, with z set to 0, inside an endless cylinder).
#[inline]
fn ball(o: DVec3, d: DVec3, radius: f64) -> Option<(f64, f64)> {
    let a = d.length_squared();
    if a < 1e-18 {
        return (o.length_squared() <= radius * radius).then_some((f64::NEG_INFINITY, f64::INFINITY));
    }
    // Measured from the point of the ray nearest to the centre, which keeps precision for far origins.
    let middle = -o.dot(d) / a;
    let square = radius * radius - (o + d * middle).length_squared();
    (square >= 0.0).then(|| {
        let half_chord = (square / a).sqrt();
        (middle - half_chord, middle + half_chord)
    })
}

impl Primitive {
    /// Where a ray in the world first meets the surface from its visible side.
    pub fn intersect(&self, ray: &Ray) -> Option<f64> {
        let direction = self.world_from_local.transpose() * ray.direction;
        self.shape.intersect(&Ray { origin: self.to_local(ray.origin), direction })
    }

    pub fn to_local(&self, p_in_world: DVec3) -> DVec3 {
        self.world_from_local.transpose() * (p_in_world - self.centre)
    }

    pub fn to_world(&self, p_in_local: DVec3) -> DVec3 {
        self.world_from_local * p_in_local + self.centre
    }

    /// Lowest and highest corner of the box around the solid, in the world.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let half = self.shape.half_extent();
        let m = self.world_from_local;
        let reach = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
        (self.centre - reach, self.centre + reach)
    }

    pub fn contains(&self, p_in_world: DVec3) -> bool {
        let p = self.to_local(p_in_world);
        match self.shape {
            Shape::Block { half } => p.abs().cmplt(half).all(),
            Shape::Cylinder { radius, half_height } => p.truncate().length() < radius && p.z.abs() < half_height,
            Shape::Ellipsoid { radii } => (p / radii).length_squared() < 1.0,
            Shape::Shell { half } => !p.abs().cmplt(half).all(),
        }
    }

    /// Distance from a point to the surface, metres; 0 inside a solid. Never too large; an ellipsoid counts as its box.
    pub fn distance(&self, p_in_world: DVec3) -> f64 {
        let p = self.to_local(p_in_world);
        match self.shape {
            Shape::Shell { half } => (half - p.abs()).min_element().max(0.0),
            Shape::Cylinder { radius, half_height } => {
                DVec2::new((p.truncate().length() - radius).max(0.0), (p.z.abs() - half_height).max(0.0)).length()
            }
            Shape::Block { half: extent } | Shape::Ellipsoid { radii: extent } => (p.abs() - extent).max(DVec3::ZERO).length(),
        }
    }
}
