//! Light that falls on each surface: area lights with soft shadows, and one bounce gathered from the surroundings.
//!
//! Irradiance is computed on a coarse grid per chart (it varies slowly, but for contact shadows, which come out soft) and
//! interpolated when surfaces are baked. Everything is a fixed set of sample directions: no noise, and the same on every run.

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::building::Rooms;
use super::bvh::Bvh;
use super::room::radiance;
use super::shapes::{ChartPoint, Primitive, Ray};
use super::texture::{Material, Place};

/// Spacing of the irradiance grid, metres.
const CELL_METRES: f64 = 0.06;
/// Cells along the sides of small charts at least, of large ones at most.
const CELLS: (f64, f64) = (2.0, 120.0);
/// Samples along each side of an area light.
const LIGHT_SIDE: usize = 4;
const GATHER_RAYS: usize = 80;
/// Rays start this far off the surface, metres.
const LIFT: f64 = 1e-3;
/// Mean radiance of a white surface in the picture: bright, but short of clipping.
const WHITE: f32 = 0.62;
/// How far the camera's white balance follows the light.
const ADAPTATION: f32 = 0.75;

/// The solids with their tree, as light and camera rays meet them.
pub struct Scene {
    pub solids: Vec<Primitive>,
    pub rooms: Rooms,
    bvh: Bvh,
}

impl Scene {
    pub fn new(solids: Vec<Primitive>, rooms: Rooms) -> Self {
        let bvh = Bvh::new(&solids);
        Self { solids, rooms, bvh }
    }

    /// The first surface along a ray that starts in the room.
    pub fn nearest(&self, ray: &Ray) -> Option<(f64, usize)> {
        let wall = self.solids[0].intersect(ray)?;
        Some(self.bvh.nearest(&self.solids, ray, wall).map_or((wall, 0), |(t, solid)| (t, solid as usize)))
    }

    /// Whether something stands between the ray's start and `limit`; the room's shell does not.
    pub fn blocked(&self, ray: &Ray, limit: f64) -> bool {
        self.bvh.blocked(&self.solids, ray, limit)
    }

    pub fn lights(&self) -> Vec<AreaLight> {
        self.solids.iter().filter_map(AreaLight::of).collect()
    }
}

/// The shining face of a luminaire or a window.
pub struct AreaLight {
    pub middle: DVec3,
    pub normal: DVec3,
    half_u: DVec3,
    half_v: DVec3,
    pub radiance: Vec3,
}

impl AreaLight {
    fn of(solid: &Primitive) -> Option<Self> {
        // A luminaire shines down (chart 4), a window into the room (chart 3, its front). Lampshades are met by gather rays.
        let chart = match solid.material {
            Material::LightPanel => 4,
            Material::Window => 3,
            _ => return None,
        };
        let size = solid.shape.charts()[chart];
        let point = solid.shape.point_at(chart, size * 0.5);
        let turn = |v: DVec3| solid.world_from_local * v;
        Some(Self {
            middle: solid.to_world(point.position),
            normal: turn(point.normal),
            half_u: turn(point.along_u) * size.x * 0.5,
            half_v: turn(point.along_v) * size.y * 0.5,
            radiance: radiance(&solid.material)?,
        })
    }

    fn area(&self) -> f64 {
        4.0 * self.half_u.length() * self.half_v.length()
    }

    /// Irradiance at a point from this light, shadows included.
    fn irradiance(&self, scene: &Scene, p: DVec3, normal: DVec3) -> Vec3 {
        let mut sum = 0.0;
        for i in 0..LIGHT_SIDE * LIGHT_SIDE {
            let place = |k: usize| ((k as f64 + 0.5) / LIGHT_SIDE as f64) * 2.0 - 1.0;
            // Off the face by a little, so that the luminaire does not shade itself.
            let source =
                self.middle + self.half_u * place(i % LIGHT_SIDE) + self.half_v * place(i / LIGHT_SIDE) + self.normal * LIFT;
            let way = source - p;
            let square = way.length_squared();
            let facing = way.dot(normal).max(0.0) * (-way.dot(self.normal)).max(0.0) / (square * square);
            if facing > 0.0 && !scene.blocked(&Ray { origin: p, direction: way }, 1.0) {
                sum += facing;
            }
        }
        self.radiance * (sum * self.area() / (LIGHT_SIDE * LIGHT_SIDE) as f64) as f32
    }
}

/// Irradiance over one chart.
#[derive(Clone)]
pub struct LightGrid {
    width: usize,
    height: usize,
    cell: DVec2,
    values: Vec<Vec3>,
}

impl LightGrid {
    pub fn at(&self, uv: DVec2) -> Vec3 {
        let top = DVec2::new(self.width as f64 - 1.0, self.height as f64 - 1.0);
        let p = (uv / self.cell - 0.5).clamp(DVec2::ZERO, top);
        let (x, y) = (p.x as usize, p.y as usize);
        let f = (p - p.floor()).as_vec2();
        let (x1, y1) = ((x + 1).min(self.width - 1), (y + 1).min(self.height - 1));
        let value = |x: usize, y: usize| self.values[y * self.width + x];
        value(x, y).lerp(value(x1, y), f.x).lerp(value(x, y1).lerp(value(x1, y1), f.x), f.y)
    }

    fn uniform(size: DVec2, value: Vec3) -> Self {
        Self { width: 1, height: 1, cell: size, values: vec![value] }
    }
}

/// The light in a room: a grid per solid and chart, scaled so that the picture is well exposed.
pub struct Lighting {
    pub grids: Vec<Vec<LightGrid>>,
    /// Mean irradiance of the room, for what moves through it.
    mean: Vec3,
    /// From relative radiance to the picture's.
    pub exposure: Vec3,
}

impl Lighting {
    pub fn compute(scene: &Scene) -> Self {
        let lights = scene.lights();
        let plan = &scene.rooms.plan;
        let room_of: Vec<usize> = lights.iter().map(|light| plan.room_at(light.middle)).collect();
        let direct = grids(scene, |point, solid| {
            let (p, normal) = lifted(solid, point);
            let here = plan.room_at(p);
            let near = lights.iter().zip(&room_of).filter(|(_, room)| plan.joined(here, **room));
            near.map(|(light, _)| light.irradiance(scene, p, normal)).sum()
        });
        let reflectance: Vec<Vec<Vec3>> = scene.solids.iter().map(mean_reflectance).collect();
        let directions = cosine_directions();
        let bounced = grids(scene, |point, solid| {
            let (origin, normal) = lifted(solid, point);
            let side = normal.any_orthonormal_vector();
            let other = normal.cross(side);
            let gathered: Vec3 = directions
                .iter()
                .map(|d| gather(scene, &direct, &reflectance, Ray { origin, direction: side * d.x + other * d.y + normal * d.z }))
                .sum();
            gathered * (std::f32::consts::PI / GATHER_RAYS as f32)
        });
        let mut grids = direct;
        let add = |(to, from): (&mut LightGrid, &LightGrid)| to.values.iter_mut().zip(&from.values).for_each(|(a, b)| *a += *b);
        grids.iter_mut().flatten().zip(bounced.iter().flatten()).for_each(add);
        let around = surroundings(scene, &grids);
        let mean = around.iter().sum::<Vec3>() / around.len() as f32;
        let gray = mean.element_sum().max(1e-6) / 3.0;
        let exposure = (mean.max(Vec3::splat(1e-6)) / gray).powf(-ADAPTATION) * (WHITE / gray);
        grids.iter_mut().flatten().flat_map(|grid| &mut grid.values).for_each(|v| *v *= exposure);
        Self { grids, mean: mean * exposure, exposure }
    }

    /// Light on a solid that is not part of the room's light: the mean, more from above.
    pub fn around(&self, solid: &Primitive) -> Vec<LightGrid> {
        let charts = solid.shape.charts().into_iter().enumerate();
        let grid = |(chart, size): (usize, DVec2)| {
            let up = (solid.world_from_local * solid.shape.point_at(chart, size * 0.5).normal).z;
            LightGrid::uniform(size, self.mean * (0.85 + 0.3 * up as f32))
        };
        charts.map(grid).collect()
    }
}

/// Light on walls and floor, which sets the exposure.
fn surroundings(scene: &Scene, grids: &[Vec<LightGrid>]) -> Vec<Vec3> {
    if scene.solids[0].material == Material::Room {
        return grids[0][..5].iter().flat_map(|grid| grid.values.iter().copied()).collect();
    }
    // The far side of outer walls has none.
    let seen = scene.solids.iter().zip(grids).filter(|(solid, _)| matches!(solid.material, Material::Room | Material::Floor));
    seen.flat_map(|(_, grids)| grids).flat_map(|grid| &grid.values).copied().filter(|v| *v != Vec3::ZERO).collect()
}

/// Fills a grid on every chart of every solid.
fn grids(scene: &Scene, irradiance: impl Fn(&ChartPoint, &Primitive) -> Vec3 + Sync) -> Vec<Vec<LightGrid>> {
    let bounds: Vec<(DVec3, DVec3)> = scene.solids.iter().map(Primitive::bounds).collect();
    let beside = |index: usize| -> Vec<usize> {
        let (low, high) = (bounds[index].0 - 2.0 * LIFT, bounds[index].1 + 2.0 * LIFT);
        let meets = |k: &usize| *k != index && bounds[*k].0.cmplt(high).all() && bounds[*k].1.cmpgt(low).all();
        (1..bounds.len()).filter(meets).collect()
    };
    let covered = |index: usize, beside: &[usize], p: DVec3| {
        let hides = |k: &usize| p.cmpgt(bounds[*k].0).all() && p.cmplt(bounds[*k].1).all() && scene.solids[*k].contains(p);
        (index != 0 && scene.solids[0].contains(p)) || beside.iter().any(hides)
    };
    let of_chart = |index: usize, beside: &[usize], chart: usize, size: DVec2| {
        let solid = &scene.solids[index];
        if !solid.material.shows(chart) {
            return LightGrid::uniform(size, Vec3::ZERO);
        }
        let count = |metres: f64| (metres / CELL_METRES).ceil().clamp(CELLS.0, CELLS.1);
        let (width, height) = (count(size.x), count(size.y));
        let cell = DVec2::new(size.x / width, size.y / height);
        let (width, height) = (width as usize, height as usize);
        let value = |i: usize| {
            let uv = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5) * cell;
            let point = solid.shape.point_at(chart, uv);
            (!covered(index, beside, lifted(solid, &point).0)).then(|| irradiance(&point, solid))
        };
        let values = filled((0..width * height).map(value).collect(), width, height);
        LightGrid { width, height, cell, values }
    };
    let of_solid = |index: usize| {
        let charts = scene.solids[index].shape.charts();
        let beside = beside(index);
        charts.into_par_iter().enumerate().map(|(chart, size)| of_chart(index, &beside, chart, size)).collect()
    };
    (0..scene.solids.len()).into_par_iter().map(of_solid).collect()
}

/// Gives cells that lie inside another solid the mean of their open neighbours, so that no darkness leaks out from under things.
fn filled(mut values: Vec<Option<Vec3>>, width: usize, height: usize) -> Vec<Vec3> {
    for _ in 0..4 {
        let before = values.clone();
        for i in (0..values.len()).filter(|i| before[*i].is_none()) {
            let (x, y) = (i % width, i / width);
            let near = (y.saturating_sub(1)..=(y + 1).min(height - 1))
                .flat_map(|ny| (x.saturating_sub(1)..=(x + 1).min(width - 1)).map(move |nx| ny * width + nx));
            let (sum, count) = near.filter_map(|k| before[k]).fold((Vec3::ZERO, 0.0), |(s, n), v| (s + v, n + 1.0));
            values[i] = (count > 0.0).then(|| sum / count);
        }
    }
    values.into_iter().map(Option::unwrap_or_default).collect()
}

fn lifted(solid: &Primitive, point: &ChartPoint) -> (DVec3, DVec3) {
    let normal = solid.world_from_local * point.normal;
    (solid.to_world(point.position) + normal * LIFT, normal)
}

/// Radiance that comes back along a ray.
fn gather(scene: &Scene, direct: &[Vec<LightGrid>], reflectance: &[Vec<Vec3>], ray: Ray) -> Vec3 {
    let Some((t, index)) = scene.nearest(&ray) else { return Vec3::ZERO };
    let solid = &scene.solids[index];
    match solid.material {
        // Already counted as area lights.
        Material::LightPanel | Material::Window => Vec3::ZERO,
        Material::Lampshade => radiance(&solid.material).unwrap_or_default(),
        _ => {
            let hit = solid.shape.chart_point(solid.to_local(ray.origin + ray.direction * t));
            // 1.5: what further bounces would add, about.
            reflectance[index][hit.chart] * direct[index][hit.chart].at(hit.uv) * (1.5 / std::f32::consts::PI)
        }
    }
}

/// Mean colour of each chart, from a few places.
fn mean_reflectance(solid: &Primitive) -> Vec<Vec3> {
    const PLACES: u32 = 24;
    let charts = solid.shape.charts().into_iter().enumerate();
    let mean = |(chart, size): (usize, DVec2)| {
        let size = size.as_vec2();
        let color = |k: u32| {
            let uv = glam::Vec2::new((k as f32 * 0.618_034).fract(), (k as f32 + 0.5) / PLACES as f32) * size;
            solid.material.color(&Place { uv, size, chart }, solid.seed)
        };
        (0..PLACES).map(color).sum::<Vec3>() / PLACES as f32
    };
    charts.map(mean).collect()
}

/// Directions about +z, as dense as the cosine to it: a spiral over the disc, lifted to the dome.
fn cosine_directions() -> Vec<DVec3> {
    let direction = |k: usize| {
        let radius = ((k as f64 + 0.5) / GATHER_RAYS as f64).sqrt();
        let (sin, cos) = (k as f64 * 2.399_963_229_728_653).sin_cos();
        DVec3::new(radius * cos, radius * sin, (1.0 - radius * radius).sqrt())
    };
    (0..GATHER_RAYS).map(direction).collect()
}
