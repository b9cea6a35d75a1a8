//! The exact surface of a scene as a mesh, as far as the recording's camera sees it: the truth that meshes of maps are compared with.
//!
//! A cell of a surface's grid is kept if its middle lies in the image at a pose of the path and nothing stands before it. Depth cameras
//! end at `degradation.max_range`, and so does the surface. Left out: the moving object, and what the sensor loses in blobs.

use glam::{DVec2, DVec3};
use nalgebra::{Point3, Vector2};
use rayon::prelude::*;

use super::config::SceneConfig;
use super::light::Scene;
use super::room::{axes, position};
use super::shapes::{Primitive, Ray, Shape};
use super::{Plan, SceneError};
use crate::geometry::{Camera, Se3};
use crate::mesh::Mesh;

/// Side of the grid's cells, metres. Planes are exact whatever it is.
const CELL_METRES: f64 = 0.02;
/// Cells along each side of an ellipsoid's six patches, and along a quarter of a cylinder's round, at least.
const LEAST_ROUND_CELLS: usize = 12;
/// A surface is seen if nothing stands before it by more than this, metres.
const LIFT_METRES: f64 = 2e-3;
/// No lens looks so far to the side that it is asked for such a ray: x/z and y/z.
const WIDEST: f64 = 2.0;
const GREY: [u8; 3] = [180; 3];

/// The visible surface in the world of the recording's poses.
///
/// # Errors
/// [`SceneError`] if the scene cannot be built.
pub fn visible_surface(config: &SceneConfig) -> Result<Mesh, SceneError> {
    let plan = Plan::new(config)?;
    let eyes = Eyes {
        camera: config.camera(),
        range: Some(config.degradation.max_range).filter(|range| *range > 0.0).unwrap_or(f64::INFINITY),
        poses: by_room(&plan),
        scene: Scene::new(plan.solids, plan.rooms),
    };
    let mut mesh = Mesh::default();
    for solid in &eyes.scene.solids {
        for chart in (0..solid.shape.charts().len()).filter(|chart| solid.material.shows(*chart)) {
            eyes.append(&Patch::new(solid, chart), &mut mesh);
        }
    }
    Ok(mesh.without_loose_vertices())
}

fn by_room(plan: &Plan) -> Vec<Vec<Se3>> {
    let rooms = &plan.rooms.plan;
    let mut poses = vec![Vec::new(); rooms.rooms()];
    for (_, pose) in &plan.sampled {
        rooms.seen_from(position(pose), &axes(pose)).into_iter().for_each(|room| poses[room].push(*pose));
    }
    poses
}

/// A chart's part of a solid's surface as a grid.
struct Patch<'a> {
    solid: &'a Primitive,
    chart: usize,
    size: DVec2,
    cells: [usize; 2],
}

impl<'a> Patch<'a> {
    fn new(solid: &'a Primitive, chart: usize) -> Self {
        let size = solid.shape.charts()[chart];
        let least = match solid.shape {
            Shape::Ellipsoid { .. } => [LEAST_ROUND_CELLS; 2],
            Shape::Cylinder { .. } if chart == 0 => [4 * LEAST_ROUND_CELLS, 1],
            Shape::Cylinder { .. } => [LEAST_ROUND_CELLS; 2],
            Shape::Block { .. } | Shape::Shell { .. } => [1; 2],
        };
        let cells = [0, 1].map(|axis| ((size[axis] / CELL_METRES).ceil() as usize).max(least[axis]));
        Self { solid, chart, size, cells }
    }

    /// A point of the surface in the world; `u` and `v` from 0 to 1.
    fn at(&self, u: f64, v: f64) -> DVec3 {
        let centred = DVec2::new(2.0 * u - 1.0, 2.0 * v - 1.0);
        let local = match self.solid.shape {
            // Patches of a cube blown up to a ball: the charts themselves overlap.
            Shape::Ellipsoid { radii } => {
                let cube = Shape::Block { half: DVec3::ONE }.point_at(self.chart, DVec2::new(2.0 * u, 2.0 * v)).position;
                cube.normalize() * radii
            }
            Shape::Cylinder { .. } if self.chart > 0 => {
                // A square drawn in to its inner circle.
                let square = centred.abs().max_element();
                let round = if square > 0.0 { centred * (square / centred.length()) } else { centred };
                self.solid.shape.point_at(self.chart, (round + 1.0) * 0.5 * self.size).position
            }
            _ => self.solid.shape.point_at(self.chart, DVec2::new(u, v) * self.size).position,
        };
        self.solid.to_world(local)
    }
}

/// Where the scene is seen from.
struct Eyes {
    camera: Camera,
    range: f64,
    /// For each room, those that may see into it.
    poses: Vec<Vec<Se3>>,
    scene: Scene,
}

impl Eyes {
    /// Whether any pose sees a point of a surface.
    fn see(&self, p: DVec3) -> bool {
        self.poses[self.scene.rooms.plan.room_at(p)].iter().any(|pose| self.shows(pose, p))
    }

    fn shows(&self, world_from_camera: &Se3, p: DVec3) -> bool {
        let p_in_camera = world_from_camera.inverse_transform_point(&Point3::new(p.x, p.y, p.z));
        let n = Vector2::new(p_in_camera.x / p_in_camera.z, p_in_camera.y / p_in_camera.z);
        if p_in_camera.z <= 0.0 || p_in_camera.z > self.range || n.amax() > WIDEST {
            return false;
        }
        let (pinhole, n) = (&self.camera.pinhole, self.camera.distortion.distort(&n));
        if !pinhole.contains(&Vector2::new(pinhole.fx * n.x + pinhole.cx, pinhole.fy * n.y + pinhole.cy), 0.0) {
            return false;
        }
        let origin = position(world_from_camera);
        let ray = Ray { origin, direction: p - origin };
        let limit = 1.0 - LIFT_METRES / ray.direction.length();
        !self.scene.blocked(&ray, limit) && self.scene.solids[0].intersect(&ray).is_none_or(|t| t > limit)
    }

    /// Adds the cells that are seen.
    fn append(&self, patch: &Patch<'_>, mesh: &mut Mesh) {
        let [width, height] = patch.cells;
        let (du, dv) = (1.0 / width as f64, 1.0 / height as f64);
        let middle = |cell: usize| patch.at(((cell % width) as f64 + 0.5) * du, ((cell / width) as f64 + 0.5) * dv);
        let seen: Vec<bool> = (0..width * height).into_par_iter().map(|cell| self.see(middle(cell))).collect();
        if !seen.contains(&true) {
            return;
        }
        let first = mesh.vertices.len() as u32;
        for corner in 0..(width + 1) * (height + 1) {
            let (x, y) = (corner % (width + 1), corner / (width + 1));
            mesh.vertices.push(patch.at(x as f64 * du, y as f64 * dv).as_vec3());
            mesh.colors.push(GREY);
        }
        for cell in (0..width * height).filter(|cell| seen[*cell]) {
            let a = first + (cell % width + cell / width * (width + 1)) as u32;
            let (b, c, d) = (a + 1, a + width as u32 + 2, a + width as u32 + 1);
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
}
