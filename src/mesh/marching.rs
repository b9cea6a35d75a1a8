//! The surface of the volume, by marching cubes. Each block owns the vertices on the edges that start at its voxels, so that blocks join without
//! seams and the order of vertices does not depend on threads.

use glam::Vec3;
use rayon::prelude::*;

use super::Mesh;
use super::tables::{CELLS, CORNERS};
use super::volume::{Block, SIDE, VOXELS, Volume, Voxel};

/// Along an edge a distance changes by the edge's length. Where it changes by more than so many of them, two surfaces meet back to back.
const STEEPEST: f32 = 3.0;

/// A vertex and the edge that it lies on: its axis, and its voxel within the block.
struct Vertex {
    edge: u16,
    position: Vec3,
    color: [u8; 3],
}

/// A block with those that follow it along the axes.
struct Around<'a> {
    /// By bits of x, y, z.
    blocks: [Option<(usize, &'a Block)>; CORNERS],
    min_views: u16,
}

impl<'a> Around<'a> {
    fn new(volume: &'a Volume, key: [i32; 3], min_views: u16) -> Self {
        let block = |bits: usize| {
            let key = [0, 1, 2].map(|axis| key[axis].saturating_add((bits >> axis & 1) as i32));
            volume.place(&key).map(|place| (place, &volume.blocks[place]))
        };
        Self { blocks: std::array::from_fn(block), min_views: min_views.max(1) }
    }

    /// The bits of the block that holds a voxel, and its place there.
    fn locate(at: [usize; 3]) -> (usize, usize) {
        let bits = (0..3).map(|axis| usize::from(at[axis] >= SIDE) << axis).sum();
        let [x, y, z] = at.map(|k| k % SIDE);
        (bits, x + SIDE * (y + SIDE * z))
    }

    /// A voxel that was seen often enough.
    fn voxel(&self, at: [usize; 3]) -> Option<&'a Voxel> {
        let (bits, place) = Self::locate(at);
        let voxel = &self.blocks[bits]?.1.voxels[place];
        (voxel.weight > 0.0 && voxel.views >= self.min_views).then_some(voxel)
    }
}

/// Steps from a voxel to a corner of its cell.
fn corner(at: [usize; 3], corner: usize) -> [usize; 3] {
    [0, 1, 2].map(|axis| at[axis] + (corner >> axis & 1))
}

fn locals() -> impl Iterator<Item = [usize; 3]> {
    (0..VOXELS).map(|i| [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE])
}

/// The triangles where the distance is zero, between voxels that at least `min_views` views saw.
pub(super) fn extract(volume: &Volume, min_views: u16) -> Mesh {
    let around = |block: &Block| Around::new(volume, block.key, min_views);
    let owned: Vec<Vec<Vertex>> = volume.blocks.par_iter().map(|block| vertices(volume, block, &around(block))).collect();
    let mut first = Vec::with_capacity(owned.len());
    let mut total = 0u32;
    for vertices in &owned {
        first.push(total);
        total += vertices.len() as u32;
    }
    let steepest = STEEPEST * volume.voxel_metres as f32;
    let triangles: Vec<Vec<[u32; 3]>> =
        volume.blocks.par_iter().map(|block| triangles(&around(block), &owned, &first, steepest)).collect();
    let mut mesh = Mesh { triangles: triangles.concat(), ..Mesh::default() };
    for vertex in owned.into_iter().flatten() {
        mesh.vertices.push(vertex.position);
        mesh.colors.push(vertex.color);
    }
    mesh.without_loose_vertices()
}

/// Where the distance changes its sign along the edges that start in a block, in the order of the edges.
fn vertices(volume: &Volume, block: &Block, around: &Around<'_>) -> Vec<Vertex> {
    let mut found = Vec::new();
    for (place, at) in locals().enumerate() {
        let Some(a) = around.voxel(at) else { continue };
        for axis in 0..3 {
            let Some(b) = around.voxel(corner(at, 1 << axis)) else { continue };
            if (a.distance < 0.0) == (b.distance < 0.0) {
                continue;
            }
            let share = a.distance / (a.distance - b.distance);
            let mut position = volume.position(block.key, at);
            position[axis] += share * volume.voxel_metres as f32;
            let mix = |k: usize| {
                let (a, b) = (f32::from(a.color[k]), f32::from(b.color[k]));
                ((a + share * (b - a)) / 256.0).round().min(255.0) as u8
            };
            found.push(Vertex { edge: (3 * place + axis) as u16, position, color: [mix(0), mix(1), mix(2)] });
        }
    }
    found
}

/// The triangles of the cells that start in a block and whose corners are all known.
fn triangles(around: &Around<'_>, owned: &[Vec<Vertex>], first: &[u32], steepest: f32) -> Vec<[u32; 3]> {
    let mut found = Vec::new();
    for at in locals() {
        let corners: [Option<&Voxel>; CORNERS] = std::array::from_fn(|c| around.voxel(corner(at, c)));
        let bit = |c: usize| corners[c].map(|voxel| usize::from(voxel.distance < 0.0) << c);
        let Some(inside) = (0..CORNERS).map(bit).sum::<Option<usize>>() else { continue };
        let cell = &CELLS[inside];
        let distance = |c: usize| corners[c].map_or(0.0, |voxel| voxel.distance);
        let is_steep =
            |edge: &super::tables::Edge| (distance(edge.corner) - distance(edge.corner | 1 << edge.axis)).abs() > steepest;
        if cell.iter().flatten().any(is_steep) {
            continue;
        }
        let vertex = |edge: super::tables::Edge| {
            let (bits, place) = Around::locate(corner(at, edge.corner));
            let (block, _) = around.blocks[bits].expect("its voxel is known");
            let edge = (3 * place + edge.axis) as u16;
            let k = owned[block].binary_search_by_key(&edge, |vertex| vertex.edge).expect("the signs at its ends differ");
            first[block] + k as u32
        };
        found.extend(cell.iter().map(|triangle| triangle.map(vertex)));
    }
    found
}
