//! Renders frames: one ray per pixel centre for depth and colour, more rays where surfaces meet, through the lens.

use std::sync::OnceLock;

use glam::{DMat3, DVec2, DVec3, Vec3, dvec3};
use nalgebra::Vector2;
use rayon::prelude::*;

use super::light::{AreaLight, LightGrid, Lighting, Scene};
use super::room::{Mover, position};
use super::shapes::{Primitive, Ray};
use super::surface::Surface;
use super::texture::Place;
use crate::geometry::{Camera, Se3};

/// Distance, metres, at which a texel of furniture (the first) or of the room's shell (the second) is as large as a pixel: about the
/// nearest at which the camera sees them.
const TEXEL_RANGE_METRES: (f64, f64) = (0.9, 1.5);
/// Sub-pixel places of the further samples; with the centre they make a regular 3 x 3 grid.
const CORNERS: [(f64, f64); 8] =
    [(-1.0, -1.0), (0.0, -1.0), (1.0, -1.0), (-1.0, 0.0), (1.0, 0.0), (-1.0, 1.0), (0.0, 1.0), (1.0, 1.0)];
const SUBPIXEL: f64 = 1.0 / 3.0;
/// Sharpness of highlights on glossy things.
const SHININESS: f32 = 50.0;

/// What the pixel-centre ray of a pixel meets.
#[derive(Clone, Copy, Debug, Default)]
pub struct Geometry {
    /// Along z, metres.
    pub depth_metres: f32,
    /// Cosine between the surface's normal and the ray.
    pub facing: f32,
    /// Solid and chart in one number.
    surface: u32,
}

/// A frame before the sensor: row-major.
pub struct Rendered {
    /// Linear radiance.
    pub color: Vec<Vec3>,
    pub geometry: Vec<Geometry>,
}

/// A moment to render: where the camera is, when it is (for what moves), and where in the pixel to look.
#[derive(Clone, Copy)]
pub struct Moment {
    pub world_from_camera: Se3,
    pub time_s: f64,
    pub subpixel: DVec2,
}

pub struct Renderer {
    scene: Scene,
    lights: Vec<AreaLight>,
    lighting: Lighting,
    mover: Option<Mover>,
    gloss: f32,
    /// Per solid and chart, baked when first seen. The mover's solids come after the scene's.
    surfaces: Vec<Vec<OnceLock<Surface>>>,
    mover_light: Vec<Vec<LightGrid>>,
    width: usize,
    height: usize,
    /// Normalised image coordinates (z = 1) of each pixel's centre.
    rays: Vec<DVec2>,
    focal: f64,
}

impl Renderer {
    pub fn new(camera: &Camera, solids: Vec<Primitive>, mover: Option<Mover>, gloss: f64) -> Self {
        let scene = Scene::new(solids);
        let lighting = Lighting::compute(&scene);
        let moving = mover.as_ref().map(|m| m.at(0.0)).unwrap_or_default();
        let charts = |solid: &Primitive| solid.shape.charts().iter().map(|_| OnceLock::new()).collect();
        let surfaces = scene.solids.iter().chain(&moving).map(charts).collect();
        let mover_light = moving.iter().map(|solid| lighting.around(solid)).collect();
        let p = camera.pinhole;
        let ray = |i: u32| {
            let recorded = Vector2::new(f64::from(i % p.width), f64::from(i / p.width));
            let n = camera.distortion.undistort(&Vector2::new((recorded.x - p.cx) / p.fx, (recorded.y - p.cy) / p.fy));
            DVec2::new(n.x, n.y)
        };
        Self {
            lights: scene.lights(),
            scene,
            lighting,
            mover,
            gloss: gloss as f32,
            surfaces,
            mover_light,
            width: p.width as usize,
            height: p.height as usize,
            rays: (0..p.width * p.height).into_par_iter().map(ray).collect(),
            focal: p.fx.max(p.fy),
        }
    }

    /// Bakes in parallel what a few frames see; the rest is baked when met. Changes nothing but the time.
    pub fn warm_up(&self, moments: &[Moment]) {
        const STRIDE: usize = 6;
        let mut seen: Vec<(usize, usize)> = moments
            .par_iter()
            .flat_map_iter(|moment| {
                let view = View::new(self, moment);
                let pixels = (0..self.height).step_by(STRIDE).flat_map(|y| (0..self.width).step_by(STRIDE).map(move |x| (x, y)));
                let mut met: Vec<(usize, usize)> = pixels.filter_map(|(x, y)| view.chart_at(x, y)).collect();
                met.sort_unstable();
                met.dedup();
                met
            })
            .collect();
        seen.sort_unstable();
        seen.dedup();
        let area = |(solid, chart): &(usize, usize)| {
            let size = self.solid(*solid).shape.charts()[*chart];
            size.x * size.y
        };
        seen.sort_by(|a, b| area(b).total_cmp(&area(a)));
        seen.into_par_iter().with_max_len(1).for_each(|(solid, chart)| {
            self.surface(solid, chart);
        });
    }

    #[cfg(test)]
    pub fn solids(&self) -> usize {
        self.scene.solids.len()
    }

    fn solid(&self, index: usize) -> Primitive {
        let still = self.scene.solids.len();
        match &self.mover {
            Some(mover) if index >= still => mover.at(0.0).swap_remove(index - still),
            _ => self.scene.solids[index].clone(),
        }
    }

    fn surface(&self, index: usize, chart: usize) -> &Surface {
        self.surfaces[index][chart].get_or_init(|| {
            let solid = self.solid(index);
            let size = solid.shape.charts()[chart];
            let light = match index.checked_sub(self.scene.solids.len()) {
                Some(moving) => &self.mover_light[moving][chart],
                None => &self.lighting.grids[index][chart],
            };
            let range = if index == 0 { TEXEL_RANGE_METRES.1 } else { TEXEL_RANGE_METRES.0 };
            let emission = solid.material.emission();
            Surface::bake(size, range / self.focal, solid.shape.wraps(chart), |uv| {
                let place = Place { uv: uv.as_vec2(), size: size.as_vec2(), chart };
                let color = solid.material.color(&place, solid.seed);
                // Only the front of a lamp or screen shines, but its sides are too thin to matter.
                emission.map_or_else(|| color * light.at(uv), |factor| color * factor)
            })
        })
    }

    /// Renders a moment; `smooth_edges` adds samples where surfaces meet.
    pub fn render(&self, moment: &Moment, smooth_edges: bool) -> Rendered {
        let view = View::new(self, moment);
        let (mut color, mut geometry) = (Vec::with_capacity(self.rays.len()), Vec::with_capacity(self.rays.len()));
        for (x, y) in (0..self.height).flat_map(|y| (0..self.width).map(move |x| (x, y))) {
            let (c, g) = view.look(x, y, moment.subpixel);
            color.push(c);
            geometry.push(g);
        }
        if smooth_edges {
            for (x, y) in (0..self.height).flat_map(|y| (0..self.width).map(move |x| (x, y))) {
                if self.on_edge(&geometry, x, y) {
                    let i = y * self.width + x;
                    let around = CORNERS.iter().map(|(u, v)| view.look(x, y, DVec2::new(*u, *v) * SUBPIXEL).0);
                    color[i] = (color[i] + around.sum::<Vec3>()) / (CORNERS.len() + 1) as f32;
                }
            }
        }
        Rendered { color, geometry }
    }

    fn on_edge(&self, geometry: &[Geometry], x: usize, y: usize) -> bool {
        let i = y * self.width + x;
        let differs = |k: usize| geometry[k].surface != geometry[i].surface;
        (x > 0 && differs(i - 1))
            || (x + 1 < self.width && differs(i + 1))
            || (y > 0 && differs(i - self.width))
            || (y + 1 < self.height && differs(i + self.width))
    }
}

/// One moment's camera and moving solids.
struct View<'a> {
    renderer: &'a Renderer,
    moving: Vec<Primitive>,
    origin: DVec3,
    world_from_camera: DMat3,
}

impl<'a> View<'a> {
    fn new(renderer: &'a Renderer, moment: &Moment) -> Self {
        let r = moment.world_from_camera.rotation.to_rotation_matrix();
        let column = |k: usize| dvec3(r[(0, k)], r[(1, k)], r[(2, k)]);
        Self {
            renderer,
            moving: renderer.mover.as_ref().map(|m| m.at(moment.time_s)).unwrap_or_default(),
            origin: position(&moment.world_from_camera),
            world_from_camera: DMat3::from_cols(column(0), column(1), column(2)),
        }
    }

    /// Nearest surface along a ray of the camera: depth and solid.
    fn nearest(&self, ray: &Ray) -> Option<(f64, usize)> {
        let mut best = self.renderer.scene.nearest(ray)?;
        for (k, solid) in self.moving.iter().enumerate() {
            if let Some(t) = solid.intersect(ray).filter(|t| *t < best.0) {
                best = (t, self.renderer.scene.solids.len() + k);
            }
        }
        Some(best)
    }

    fn solid(&self, index: usize) -> &Primitive {
        let still = &self.renderer.scene.solids;
        if index < still.len() { &still[index] } else { &self.moving[index - still.len()] }
    }

    /// The directions of a pixel's ray and their change from one pixel to the next, right and down; z is 1 in the camera.
    fn ray(&self, x: usize, y: usize, subpixel: DVec2) -> (Ray, DVec3, DVec3) {
        let r = self.renderer;
        let at = |x: usize, y: usize| r.rays[y * r.width + x];
        let centre = at(x, y);
        let dx = if x + 1 < r.width { at(x + 1, y) - centre } else { centre - at(x - 1, y) };
        let dy = if y + 1 < r.height { at(x, y + 1) - centre } else { centre - at(x, y - 1) };
        let n = centre + dx * subpixel.x + dy * subpixel.y;
        let turn = |v: DVec3| self.world_from_camera * v;
        (Ray { origin: self.origin, direction: turn(n.extend(1.0)) }, turn(dx.extend(0.0)), turn(dy.extend(0.0)))
    }

    fn chart_at(&self, x: usize, y: usize) -> Option<(usize, usize)> {
        let (ray, ..) = self.ray(x, y, DVec2::ZERO);
        let (t, index) = self.nearest(&ray)?;
        let solid = self.solid(index);
        Some((index, solid.shape.chart_point(solid.to_local(ray.origin + ray.direction * t)).chart))
    }

    /// Colour and geometry seen at a place in a pixel.
    fn look(&self, x: usize, y: usize, subpixel: DVec2) -> (Vec3, Geometry) {
        let (ray, dx, dy) = self.ray(x, y, subpixel);
        let Some((t, index)) = self.nearest(&ray) else { return (Vec3::ZERO, Geometry::default()) };
        let solid = self.solid(index);
        let hit_in_world = ray.origin + ray.direction * t;
        let hit = solid.shape.chart_point(solid.to_local(hit_in_world));
        let local_from_world = solid.world_from_local.transpose();
        let d = local_from_world * ray.direction;
        let along = hit.normal.dot(d);
        // How the hit moves on the surface's tangent plane from one pixel to the next.
        let step = |change: DVec3| {
            let change = local_from_world * change;
            let moved = (change - d * (hit.normal.dot(change) / along.min(-1e-3))) * t;
            DVec2::new(moved.dot(hit.along_u), moved.dot(hit.along_v))
        };
        let mut color = self.renderer.surface(index, hit.chart).sample(hit.uv, step(dx), step(dy));
        if self.renderer.gloss > 0.0 {
            let normal = solid.world_from_local * hit.normal;
            color += self.highlight(solid.material.gloss() * self.renderer.gloss, hit_in_world, normal, ray.direction);
        }
        let facing = (-along / ray.direction.length()) as f32;
        let geometry = Geometry { depth_metres: t as f32, facing, surface: (index * 8 + hit.chart) as u32 };
        (color, geometry)
    }

    /// Blinn-Phong highlights of the area lights, each taken as a point, shadowed.
    fn highlight(&self, gloss: f32, p: DVec3, normal: DVec3, direction: DVec3) -> Vec3 {
        if gloss <= 0.0 {
            return Vec3::ZERO;
        }
        let seen = |light: &AreaLight| {
            let way = light.middle + light.normal * 1e-3 - p;
            let half = (way.normalize() - direction.normalize()).normalize_or_zero();
            let strength = gloss * (half.dot(normal).max(0.0) as f32).powf(SHININESS);
            let ray = Ray { origin: p + normal * 1e-3, direction: way };
            if strength < 1e-3 || way.dot(normal) <= 0.0 || self.renderer.scene.blocked(&ray, 1.0) {
                return Vec3::ZERO;
            }
            light.radiance * self.renderer.lighting.exposure * (0.1 * strength)
        };
        self.renderer.lights.iter().map(seen).sum()
    }
}
