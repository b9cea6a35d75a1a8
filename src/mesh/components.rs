//! Connected components: surfaces that share no vertex with another.

use super::Mesh;

/// A forest over the vertices; the root of a tree is its smallest vertex.
struct Forest(Vec<u32>);

impl Forest {
    fn root(&mut self, mut i: u32) -> u32 {
        while self.0[i as usize] != i {
            let above = self.0[self.0[i as usize] as usize];
            self.0[i as usize] = above;
            i = above;
        }
        i
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

/// The component of each vertex, named by its smallest vertex.
pub(super) fn components(mesh: &Mesh) -> Vec<u32> {
    let mut forest = Forest((0..mesh.vertices.len() as u32).collect());
    for [a, b, c] in &mesh.triangles {
        forest.join(*a, *b);
        forest.join(*b, *c);
    }
    (0..mesh.vertices.len() as u32).map(|i| forest.root(i)).collect()
}

/// Keeps the components whose area is at least this share of the largest one's.
pub fn keep_components(mut mesh: Mesh, least_share: f64) -> Mesh {
    let names = components(&mesh);
    let mut areas = vec![0.0f64; mesh.vertices.len()];
    mesh.triangles.iter().for_each(|triangle| areas[names[triangle[0] as usize] as usize] += mesh.triangle_area(triangle));
    let largest = areas.iter().copied().fold(0.0, f64::max);
    mesh.triangles.retain(|[a, ..]| areas[names[*a as usize] as usize] >= least_share * largest);
    mesh.without_loose_vertices()
}

/// Keeps the components of at least so many vertices.
pub(super) fn keep_larger(mut mesh: Mesh, least_vertices: usize) -> Mesh {
    let names = components(&mesh);
    let mut sizes = vec![0usize; mesh.vertices.len()];
    names.iter().for_each(|name| sizes[*name as usize] += 1);
    mesh.triangles.retain(|[a, ..]| sizes[names[*a as usize] as usize] >= least_vertices);
    mesh.without_loose_vertices()
}
