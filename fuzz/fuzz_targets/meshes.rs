//! Meshes as PLY files. Triangles of a mesh that was read name vertices that are there, and all values are finite.
#![no_main]

use std::path::Path;

use keysplat::mesh::Mesh;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(mesh) = Mesh::decode(bytes, Path::new("file")) {
        assert!(mesh.vertices.iter().all(|p| p.is_finite()));
        assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.vertices.len()));
    }
});
