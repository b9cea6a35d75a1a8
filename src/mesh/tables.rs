//! The triangles of each of the 256 cells of marching cubes (Lorensen & Cline 1987), derived rather than typed.
//!
//! On each face, every run of neighbouring inside corners is cut off by one line. The rule looks the same from both sides of a face, so that
//! cells fit together without cracks, also where a face is ambiguous. The lines of a cell's faces close to loops, and fans fill the loops.

use std::sync::LazyLock;

/// Corner `c` is at x = bit 0, y = bit 1, z = bit 2.
pub(super) const CORNERS: usize = 8;

/// Corners of each face, counter-clockwise from outside the cell.
const FACES: [[usize; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// An edge: its axis, and the corner that it starts at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Edge {
    pub axis: usize,
    pub corner: usize,
}

/// The edge between two corners that differ in one bit.
fn edge_between(a: usize, b: usize) -> Edge {
    Edge { axis: (a ^ b).trailing_zeros() as usize, corner: a & b }
}

/// Whether an edge lies on a face.
fn lies_on(edge: Edge, face: &[usize; 4]) -> bool {
    face.contains(&edge.corner) && face.contains(&(edge.corner | 1 << edge.axis))
}

/// Triangles of each cell by the bits of its inside corners; each corner of a triangle lies on an edge.
pub(super) static CELLS: LazyLock<Vec<Vec<[Edge; 3]>>> = LazyLock::new(|| (0..1usize << CORNERS).map(triangles).collect());

fn triangles(inside: usize) -> Vec<[Edge; 3]> {
    let mut lines: Vec<(Edge, Edge)> = FACES.iter().flat_map(|face| lines(inside, face)).collect();
    let mut triangles = Vec::new();
    while let Some((start, mut end)) = lines.pop() {
        let mut corners = vec![start];
        while end != start {
            corners.push(end);
            let next = lines.iter().position(|(from, _)| *from == end).expect("each cut edge is on two faces");
            end = lines.swap_remove(next).1;
        }
        triangles.extend(fan(&corners));
    }
    triangles
}

/// The lines on a face, the inside on their right for one who looks from outside the cell.
fn lines(inside: usize, face: &[usize; 4]) -> Vec<(Edge, Edge)> {
    let is_inside = |k: usize| inside >> face[k % 4] & 1 == 1;
    let cut = |k: usize| edge_between(face[k % 4], face[(k + 1) % 4]);
    let starts = (0..4).filter(|k| !is_inside(*k) && is_inside(k + 1));
    let line = |start: usize| {
        let end = (start + 1..start + 4).find(|k| is_inside(*k) && !is_inside(k + 1)).expect("a run that starts ends");
        (cut(start), cut(end))
    };
    starts.map(line).collect()
}

/// A fan over a loop, from the corner whose diagonals lie least on faces: there they might coincide with the next cell's.
fn fan(corners: &[Edge]) -> Vec<[Edge; 3]> {
    let n = corners.len();
    let on_faces = |start: &usize| {
        let diagonal = |k: usize| (corners[*start], corners[(start + k) % n]);
        let flat = |k: &usize| FACES.iter().any(|face| lies_on(diagonal(*k).0, face) && lies_on(diagonal(*k).1, face));
        (2..n - 1).filter(flat).count()
    };
    let start = (0..n).min_by_key(on_faces).expect("a loop has corners");
    (1..n - 1).map(|k| [corners[start], corners[(start + k) % n], corners[(start + k + 1) % n]]).collect()
}
