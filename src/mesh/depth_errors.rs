//! Depth of a mesh against that of the true surface, seen from given cameras.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde::Serialize;

use super::Mesh;
use crate::geometry::{Pinhole, Se3};

/// Depth of the plane that cuts triangles off, metres.
const NEAR_METRES: f64 = 0.01;

/// Depth errors over all views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DepthErrors {
    /// Views compared.
    pub views: usize,
    /// Mean absolute difference of depth where both surfaces are seen, metres.
    pub depth_l1_m: f64,
    /// Share of the pixels of the true surface that see the mesh, too.
    pub seen_share: f64,
}

/// Compares depth from each camera (world from camera, in the truth's world); `None` if nothing is seen.
pub fn compare_depth(mesh: &Mesh, truth: &Mesh, pinhole: &Pinhole, cameras: &[Se3]) -> Option<DepthErrors> {
    let of_view = |camera: &Se3| {
        let (ours, true_depth) = (depth(mesh, pinhole, camera), depth(truth, pinhole, camera));
        let pairs = ours.iter().zip(&true_depth).filter(|(_, z)| z.is_finite());
        pairs.fold((0.0, 0usize, 0usize), |(sum, both, all), (z, true_z)| match z.is_finite() {
            true => (sum + f64::from((z - true_z).abs()), both + 1, all + 1),
            false => (sum, both, all + 1),
        })
    };
    let of_views: Vec<_> = cameras.par_iter().map(of_view).collect();
    let (sum, both, all) = of_views.iter().fold((0.0, 0, 0), |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2));
    (both > 0).then(|| DepthErrors { views: cameras.len(), depth_l1_m: sum / both as f64, seen_share: both as f64 / all as f64 })
}

/// `[H, W]` depth of the nearest triangle along z, metres; infinite where there is none.
fn depth(mesh: &Mesh, pinhole: &Pinhole, world_from_camera: &Se3) -> Vec<f32> {
    let camera_from_world = world_from_camera.inverse();
    let in_camera: Vec<Vector3<f64>> =
        mesh.vertices.iter().map(|p| (camera_from_world * Point3::from(p.to_array().map(f64::from))).coords).collect();
    let mut depth = vec![f32::INFINITY; (pinhole.width * pinhole.height) as usize];
    for triangle in &mesh.triangles {
        let corners = triangle.map(|i| in_camera[i as usize]);
        let before = corners.iter().filter(|p| p.z > NEAR_METRES).count();
        match before {
            0 => {}
            3 => draw(&corners, pinhole, &mut depth),
            _ => {
                let part = clipped(&corners);
                part.windows(2).skip(1).for_each(|edge| draw(&[part[0], edge[0], edge[1]], pinhole, &mut depth));
            }
        }
    }
    depth
}

/// Corners of the part of a triangle that lies beyond the near plane (Sutherland & Hodgman 1974).
fn clipped(corners: &[Vector3<f64>; 3]) -> Vec<Vector3<f64>> {
    let mut part = Vec::with_capacity(4);
    for (a, b) in (0..3).map(|k| (corners[k], corners[(k + 1) % 3])) {
        if a.z > NEAR_METRES {
            part.push(a);
        }
        if (a.z > NEAR_METRES) != (b.z > NEAR_METRES) {
            part.push(a.lerp(&b, (NEAR_METRES - a.z) / (b.z - a.z)));
        }
    }
    part
}

/// Draws one triangle; inverse depth is linear over the image.
fn draw(corners: &[Vector3<f64>; 3], pinhole: &Pinhole, depth: &mut [f32]) {
    let pixels = corners.map(|p| (pinhole.fx * p.x / p.z + pinhole.cx, pinhole.fy * p.y / p.z + pinhole.cy));
    let [(ax, ay), (bx, by), (cx, cy)] = pixels;
    let area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if area.abs() < 1e-12 {
        return;
    }
    let range = |values: [f64; 3], size: u32| {
        let (low, high) = (values.iter().copied().fold(f64::MAX, f64::min), values.iter().copied().fold(f64::MIN, f64::max));
        low.ceil().max(0.0) as u32..(high.floor() + 1.0).clamp(0.0, f64::from(size)) as u32
    };
    for y in range([ay, by, cy], pinhole.height) {
        for x in range([ax, bx, cx], pinhole.width) {
            let (px, py) = (f64::from(x), f64::from(y));
            let b = ((px - ax) * (cy - ay) - (py - ay) * (cx - ax)) / area;
            let c = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area;
            let a = 1.0 - b - c;
            if a < 0.0 || b < 0.0 || c < 0.0 {
                continue;
            }
            let z = (a / corners[0].z + b / corners[1].z + c / corners[2].z).recip() as f32;
            let nearest = &mut depth[(y * pinhole.width + x) as usize];
            *nearest = nearest.min(z);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    /// Two triangles that begin far behind the camera.
    #[test]
    fn a_floor_is_seen_from_where_the_camera_stands() {
        let pinhole = Pinhole { fx: 40.0, fy: 40.0, cx: 15.5, cy: 11.5, width: 32, height: 24 };
        let corner = |x: f32, z: f32| Vec3::new(x, 1.0, z);
        let vertices = vec![corner(-20.0, -20.0), corner(20.0, -20.0), corner(20.0, 20.0), corner(-20.0, 20.0)];
        let floor = Mesh { colors: vec![[0; 3]; 4], triangles: vec![[0, 1, 2], [0, 2, 3]], vertices };
        let seen = depth(&floor, &pinhole, &Se3::identity());
        for (i, z) in seen.iter().enumerate() {
            let below = f64::from(i as u32 / pinhole.width) - pinhole.cy;
            let expected = pinhole.fy / below;
            match below > 0.0 && expected < 20.0 {
                true => assert!((f64::from(*z) - expected).abs() < 1e-4 * expected, "{i}: {z} is not {expected}"),
                false => assert!(z.is_infinite(), "{i}: {z}"),
            }
        }
    }
}
