//! Renders frames: one ray per pixel centre for depth and colour, more rays where surfaces meet, through the lens.

use std::sync::OnceLock;

use glam::{DVec2, DVec3, Vec3};
use nalgebra::Vector2;
use rayon::prelude::*;

use super::light::{AreaLight, LightGrid, Lighting, Scene};
use super::room::Mover;
use super::shapes::{Primitive, Ray};
use super::surface::Surface;
use super::texture::Place;
use super::view::View;
use crate::geometry::{Camera, Se3};

/// Distance, metres, at which a texel of furniture (the first) or of walls, floor and ceiling (the second) is as large as a pixel: about the
/// nearest at which the camera sees them.
const TEXEL_RANGE_METRES: (f64, f64) = (1.0, 1.7);
/// Sub-pixel places of the further samples at edges; with the centre they make the five of a die.
const CORNERS: [(f64, f64); 4] = [(-SUBPIXEL, -SUBPIXEL), (SUBPIXEL, -SUBPIXEL), (-SUBPIXEL, SUBPIXEL), (SUBPIXEL, SUBPIXEL)];
const SUBPIXEL: f64 = 0.3;
/// Side of the squares of pixels for which solids are sorted out together.
const TILE: usize = 8;
/// Sharpness of highlights on glossy things.
const SHININESS: f32 = 50.0;

/// Surface hit by a pixel's central ray.
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
    tiles: Vec<Tile>,
    focal: f64,
}

impl Renderer {
    pub fn new(camera: &Camera, scene: Scene, mover: Option<Mover>, gloss: f64) -> Self {
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
        let (width, height) = (p.width as usize, p.height as usize);
        let rays: Vec<DVec2> = (0..p.width * p.height).into_par_iter().map(ray).collect();
        Self {
            tiles: tiles(width, height, &rays),
            lights: scene.lights(),
            scene,
            lighting,
            mover,
            gloss: gloss as f32,
            surfaces,
            mover_light,
            width,
            height,
            rays,
            focal: p.fx.max(p.fy),
        }
    }

    /// Bakes in parallel what a few frames see; the rest is baked when met. Changes nothing but the time.
    pub fn warm_up(&self, moments: &[Moment]) {
        let mut seen: Vec<(usize, usize)> = moments
            .par_iter()
            .flat_map_iter(|moment| {
                let moving = self.moving(moment.time_s);
                let view = View::new(&moment.world_from_camera, &self.scene, &moving);
                let mut candidates = Vec::new();
                let mut met = Vec::new();
                for tile in &self.tiles {
                    view.candidates(tile.low, tile.high, &mut candidates);
                    for n in [self.rays[tile.y.start * self.width + tile.x.start], (tile.low + tile.high) * 0.5] {
                        met.extend(view.first(n, &candidates).map(|first| {
                            let item = &view.projected[first.item];
                            let hit = item.origin + item.local_from_camera * n.extend(1.0) * first.depth_metres;
                            (item.solid, view.solid(item.solid).shape.chart_point(hit).chart)
                        }));
                    }
                }
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
    pub fn rooms(&self) -> &super::building::Rooms {
        &self.scene.rooms
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
            let range = if solid.material.is_structure() { TEXEL_RANGE_METRES.1 } else { TEXEL_RANGE_METRES.0 };
            let emission = solid.material.emission();
            Surface::bake(size, range / self.focal, solid.shape.wraps(chart), |uv| {
                let place = Place { uv: uv.as_vec2(), size: size.as_vec2(), chart };
                let color = solid.material.color(&place, solid.seed);
                // Only the front of a lamp or screen shines, but its sides are too thin to matter.
                emission.map_or_else(|| color * light.at(uv), |factor| color * factor)
            })
        })
    }

    fn moving(&self, time_s: f64) -> Vec<Primitive> {
        self.mover.as_ref().map(|m| m.at(time_s)).unwrap_or_default()
    }

    /// Renders a moment; `smooth_edges` adds samples where surfaces meet.
    pub fn render(&self, moment: &Moment, smooth_edges: bool) -> Rendered {
        let moving = self.moving(moment.time_s);
        let view = View::new(&moment.world_from_camera, &self.scene, &moving);
        let mut color = vec![Vec3::ZERO; self.rays.len()];
        let mut geometry = vec![Geometry::default(); self.rays.len()];
        let mut candidates = Vec::new();
        for tile in &self.tiles {
            view.candidates(tile.low, tile.high, &mut candidates);
            for (x, y) in tile.pixels() {
                (color[y * self.width + x], geometry[y * self.width + x]) = self.look(&view, x, y, moment.subpixel, &candidates);
            }
        }
        if smooth_edges {
            let mut edges = Vec::new();
            for tile in &self.tiles {
                edges.clear();
                edges.extend(tile.pixels().filter(|(x, y)| self.on_edge(&geometry, *x, *y)));
                if edges.is_empty() {
                    continue;
                }
                view.candidates(tile.low, tile.high, &mut candidates);
                for (x, y) in &edges {
                    let look = |(u, v): &(f64, f64)| self.look(&view, *x, *y, DVec2::new(*u, *v), &candidates).0;
                    let i = y * self.width + x;
                    color[i] = (color[i] + CORNERS.iter().map(look).sum::<Vec3>()) / (CORNERS.len() + 1) as f32;
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

    /// A pixel's ray on the image plane, and its change from one pixel to the next, right and down.
    fn ray(&self, x: usize, y: usize) -> (DVec2, DVec2, DVec2) {
        let at = |x: usize, y: usize| self.rays[y * self.width + x];
        let n = at(x, y);
        let dx = if x + 1 < self.width { at(x + 1, y) - n } else { n - at(x - 1, y) };
        let dy = if y + 1 < self.height { at(x, y + 1) - n } else { n - at(x, y - 1) };
        (n, dx, dy)
    }

    /// Colour and geometry seen at a place in a pixel.
    fn look(&self, view: &View, x: usize, y: usize, subpixel: DVec2, candidates: &[u32]) -> (Vec3, Geometry) {
        let (n, dx, dy) = self.ray(x, y);
        let n = n + dx * subpixel.x + dy * subpixel.y;
        let Some(met) = view.first(n, candidates) else { return (Vec3::ZERO, Geometry::default()) };
        let item = &view.projected[met.item];
        let solid = view.solid(item.solid);
        let d = item.local_from_camera * n.extend(1.0);
        let hit = solid.shape.chart_point(item.origin + d * met.depth_metres);
        let along = hit.normal.dot(d);
        // How the hit moves on the surface's tangent plane from one pixel to the next.
        let step = |change: DVec2| {
            let change = item.local_from_camera * change.extend(0.0);
            let moved = (change - d * (hit.normal.dot(change) / along.min(-1e-3))) * met.depth_metres;
            DVec2::new(moved.dot(hit.along_u), moved.dot(hit.along_v))
        };
        let mut color = self.surface(item.solid, hit.chart).sample(hit.uv, step(dx), step(dy));
        if self.gloss > 0.0 {
            let strength = solid.material.gloss() * self.gloss;
            color += self.highlight(strength, solid.to_world(hit.position), solid.world_from_local * hit.normal, view.origin);
        }
        let facing = (-along / d.length()) as f32;
        (color, Geometry { depth_metres: met.depth_metres as f32, facing, surface: (item.solid * 8 + hit.chart) as u32 })
    }

    /// Blinn-Phong highlights of the area lights, each taken as a point, shadowed.
    fn highlight(&self, gloss: f32, p: DVec3, normal: DVec3, eye: DVec3) -> Vec3 {
        if gloss <= 0.0 {
            return Vec3::ZERO;
        }
        let seen = |light: &AreaLight| {
            let way = light.middle + light.normal * 1e-3 - p;
            let half = (way.normalize() + (eye - p).normalize()).normalize_or_zero();
            let strength = gloss * (half.dot(normal).max(0.0) as f32).powf(SHININESS);
            let ray = Ray { origin: p + normal * 1e-3, direction: way };
            if strength < 1e-3 || way.dot(normal) <= 0.0 || self.scene.blocked(&ray, 1.0) {
                return Vec3::ZERO;
            }
            light.radiance * self.lighting.exposure * (0.1 * strength)
        };
        self.lights.iter().map(seen).sum()
    }
}

/// A square of pixels and the rectangle of the image plane around its rays.
struct Tile {
    x: std::ops::Range<usize>,
    y: std::ops::Range<usize>,
    low: DVec2,
    high: DVec2,
}

impl Tile {
    fn pixels(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.y.clone().flat_map(|y| self.x.clone().map(move |x| (x, y)))
    }
}

/// Cuts the image into tiles; their rectangles reach a pixel further, for samples beside the centres.
fn tiles(width: usize, height: usize, rays: &[DVec2]) -> Vec<Tile> {
    let corners = (0..height).step_by(TILE).flat_map(|y| (0..width).step_by(TILE).map(move |x| (x, y)));
    let tile = |(x, y): (usize, usize)| {
        let mut tile =
            Tile { x: x..(x + TILE).min(width), y: y..(y + TILE).min(height), low: DVec2::INFINITY, high: DVec2::NEG_INFINITY };
        for ray in tile.pixels().map(|(x, y)| rays[y * width + x]).collect::<Vec<_>>() {
            (tile.low, tile.high) = (tile.low.min(ray), tile.high.max(ray));
        }
        let pixel = (tile.high - tile.low) / (TILE.min(width).min(height) - 1) as f64;
        (tile.low, tile.high) = (tile.low - 2.0 * pixel, tile.high + 2.0 * pixel);
        tile
    };
    corners.map(tile).collect()
}
