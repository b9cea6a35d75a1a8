//! Fewer triangles: quadric error collapses (Garland & Heckbert 1997) by meshoptimizer.

use meshopt::{SimplifyOptions, VertexDataAdapter};

use super::Mesh;

/// Collapses may move the surface by this share of the mesh's extent, at most.
const MOST_ERROR: f32 = 0.01;

/// Collapses edges until this share of the triangles is left, or the surface would move too far. Borders stay where they are.
pub fn simplify(mesh: &Mesh, share: f64) -> Mesh {
    let indices: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
    let target = 3 * (mesh.triangles.len() as f64 * share).ceil() as usize;
    let positions: &[u8] = bytemuck::cast_slice(&mesh.vertices);
    let adapter = VertexDataAdapter::new(positions, size_of::<glam::Vec3>(), 0).expect("whole vertices");
    let left = meshopt::simplify(&indices, &adapter, target, MOST_ERROR, SimplifyOptions::LockBorder, None);
    let triangles = left.chunks_exact(3).map(|corners| [corners[0], corners[1], corners[2]]).collect();
    Mesh { triangles, ..mesh.clone() }.without_loose_vertices()
}
