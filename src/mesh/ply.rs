//! Meshes as binary little-endian PLY (Turk 1994).
//!
//! Reads any such file whose elements are `vertex`, with x, y and z as floats or doubles and colours as bytes, then `face`, with one list of
//! indices. Polygons become fans. Left out: ASCII and big-endian files, and elements beside these two.

use super::Mesh;
use crate::files::ply::{Element, Encoding, Header, Property, Scalar, Vertices};

/// The whole file.
pub(super) fn encode(mesh: &Mesh) -> Vec<u8> {
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nelement face {}\nproperty list uchar uint vertex_indices\nend_header\n",
        mesh.vertices.len(),
        mesh.triangles.len()
    );
    let mut bytes = header.into_bytes();
    bytes.reserve_exact(15 * mesh.vertices.len() + 13 * mesh.triangles.len());
    for (p, color) in mesh.vertices.iter().zip(&mesh.colors) {
        p.to_array().iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(color);
    }
    for triangle in &mesh.triangles {
        bytes.push(3);
        triangle.iter().for_each(|i| bytes.extend(i.to_le_bytes()));
    }
    bytes
}

/// Reads a file; errors say what is wrong with it.
pub(super) fn decode(bytes: &[u8]) -> Result<Mesh, String> {
    let header = Header::read(&mut &*bytes, &[Encoding::BinaryLittleEndian]).map_err(|error| error.to_string())?;
    let (Vertices { positions, colors }, faces) = Vertices::after(&header, bytes)?;
    let face = header.elements.get(1).filter(|element| element.name == "face");
    let face = face.ok_or("its vertices are not followed by faces: it is a map or a cloud of points")?;
    let mut mesh = Mesh { vertices: positions, colors, ..Mesh::default() };
    read_faces(face, faces, &mut mesh)?;
    Ok(mesh)
}

fn read_faces(face: &Element, mut bytes: &[u8], mesh: &mut Mesh) -> Result<(), String> {
    let is_indices = |property: &&Property| matches!(property.name.as_str(), "vertex_indices" | "vertex_index");
    if face.properties.iter().find(is_indices).is_none_or(|property| property.length.is_none()) {
        return Err("its faces have no list of vertex_indices".into());
    }
    let mut corners = Vec::new();
    for index in 0..face.count {
        for property in &face.properties {
            let mut take = |kind: Scalar| {
                let (value, rest) = (bytes.get(..kind.bytes()).map(|b| kind.read(b)), bytes.get(kind.bytes()..));
                bytes = rest.unwrap_or_default();
                value.ok_or_else(|| format!("it is cut off at face {index}"))
            };
            let count = property.length.map_or(Ok(1.0), &mut take)?;
            corners.clear();
            for _ in 0..count as usize {
                corners.push(take(property.kind)?);
            }
            if is_indices(&property) {
                push_polygon(&corners, mesh).ok_or_else(|| format!("face {index} names a vertex that is not there"))?;
            }
        }
    }
    Ok(())
}

/// A fan over the corners; `None` if one is no vertex.
fn push_polygon(corners: &[f64], mesh: &mut Mesh) -> Option<()> {
    let count = mesh.vertices.len() as f64;
    if corners.iter().any(|corner| !(0.0..count).contains(corner)) {
        return None;
    }
    for pair in corners.get(1..).unwrap_or_default().windows(2) {
        mesh.triangles.push([corners[0], pair[0], pair[1]].map(|corner| corner as u32));
    }
    Some(())
}
