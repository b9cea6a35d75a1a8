//! Files of meshes: PLY, glTF binary and OBJ, with a colour at each vertex. All in the world of the map but glTF, whose y is up and z backward.

use std::path::Path;

use serde_json::json;

use super::{Mesh, MeshError, ply};
use crate::files::write_atomically;

/// A file format of meshes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// Binary little endian; every viewer reads it.
    Ply,
    /// glTF 2.0 binary, unlit: the colours hold the light.
    Glb,
    /// Text, with colours behind the positions.
    Obj,
}

impl MeshFormat {
    /// All formats.
    pub const ALL: [Self; 3] = [Self::Ply, Self::Glb, Self::Obj];

    /// Extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Glb => "glb",
            Self::Obj => "obj",
        }
    }

    /// The format of a file's extension, in any case.
    ///
    /// # Errors
    /// [`MeshError::Format`] if it is no format.
    pub fn of_path(path: &Path) -> Result<Self, MeshError> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        let known = Self::ALL.into_iter().find(|format| format.extension().eq_ignore_ascii_case(ending));
        known.ok_or_else(|| MeshError::Format { path: path.into() })
    }

    /// Encodes and writes a mesh: the same bytes for the same mesh. Returns their number.
    ///
    /// # Errors
    /// If the mesh is too large for the format, or the file cannot be written.
    pub fn write(self, mesh: &Mesh, path: &Path) -> Result<usize, MeshError> {
        let bytes = match self {
            Self::Ply => ply::encode(mesh),
            Self::Glb => glb(mesh, path)?,
            Self::Obj => obj(mesh),
        };
        write_atomically(path, &bytes)?;
        Ok(bytes.len())
    }
}

impl Mesh {
    /// Reads a PLY file: triangles and polygons, with or without colours.
    ///
    /// # Errors
    /// [`MeshError`] if the file cannot be read, is no mesh, is cut off, or holds a value that is not finite.
    pub fn read(path: &Path) -> Result<Self, MeshError> {
        let bytes = std::fs::read(path).map_err(|source| MeshError::Read { path: path.into(), source })?;
        Self::decode(&bytes, path)
    }

    /// Reads a PLY file from its bytes; the path is named in errors.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn decode(bytes: &[u8], path: &Path) -> Result<Self, MeshError> {
        ply::decode(bytes).map_err(|what| MeshError::Damaged { path: path.into(), what })
    }
}

fn obj(mesh: &Mesh) -> Vec<u8> {
    use std::fmt::Write;
    let mut text = String::with_capacity(64 * mesh.vertices.len() + 24 * mesh.triangles.len());
    for (p, color) in mesh.vertices.iter().zip(&mesh.colors) {
        let [r, g, b] = color.map(|v| f32::from(v) / 255.0);
        writeln!(text, "v {} {} {} {r:.4} {g:.4} {b:.4}", p.x, p.y, p.z).expect("a string takes all");
    }
    for [a, b, c] in mesh.triangles.iter().map(|triangle| triangle.map(|i| i + 1)) {
        writeln!(text, "f {a} {b} {c}").expect("a string takes all");
    }
    text.into_bytes()
}

/// Of sRGB, in 65,535ths: glTF's vertex colours are linear.
fn linear(value: u8) -> u16 {
    let v = f64::from(value) / 255.0;
    let linear = if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    (linear * 65535.0).round() as u16
}

fn glb(mesh: &Mesh, path: &Path) -> Result<Vec<u8>, MeshError> {
    let turned: Vec<[f32; 3]> = mesh.vertices.iter().map(|p| [p.x, -p.y, -p.z]).collect();
    let to_linear: [u16; 256] = std::array::from_fn(|v| linear(v as u8));
    let colors =
        mesh.colors.iter().flat_map(|c| [to_linear[c[0] as usize], to_linear[c[1] as usize], to_linear[c[2] as usize], u16::MAX]);
    let parts = [
        turned.iter().flatten().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        colors.flat_map(u16::to_le_bytes).collect(),
        mesh.triangles.iter().flatten().flat_map(|i| i.to_le_bytes()).collect(),
    ];
    let corner = |pick: fn(f32, f32) -> f32| [0, 1, 2].map(|axis| turned.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0));
    let lengths = [parts[0].len(), parts[1].len(), parts[2].len()];
    let header = json!({
        "asset": { "version": "2.0", "generator": concat!("keysplat ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "surface" }],
        "materials": [{
            "doubleSided": true,
            "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 },
            "extensions": { "KHR_materials_unlit": {} }
        }],
        "meshes": [{ "primitives": [{ "mode": 4, "material": 0, "attributes": { "POSITION": 0, "COLOR_0": 1 }, "indices": 2 }] }],
        "buffers": [{ "byteLength": lengths.iter().sum::<usize>() }],
        // 34962: ARRAY_BUFFER, 34963: ELEMENT_ARRAY_BUFFER.
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": lengths[0], "target": 34962 },
            { "buffer": 0, "byteOffset": lengths[0], "byteLength": lengths[1], "target": 34962 },
            { "buffer": 0, "byteOffset": lengths[0] + lengths[1], "byteLength": lengths[2], "target": 34963 },
        ],
        // 5126: float, 5123: unsigned short, 5125: unsigned int.
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": turned.len(), "type": "VEC3", "min": corner(f32::min), "max": corner(f32::max) },
            { "bufferView": 1, "componentType": 5123, "normalized": true, "count": turned.len(), "type": "VEC4" },
            { "bufferView": 2, "componentType": 5125, "count": 3 * mesh.triangles.len(), "type": "SCALAR" },
        ],
    });
    let mut text = header.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let binary = parts.concat();
    let too_large = || MeshError::TooLargeForFormat { path: path.into(), reason: "a GLB has at most 4 GiB" };
    let length = u32::try_from(28 + text.len() + binary.len()).map_err(|_| too_large())?;
    let chunk = |kind: &[u8; 4], body: &[u8]| [&(body.len() as u32).to_le_bytes(), kind.as_slice(), body].concat();
    Ok([b"glTF".as_slice(), &2u32.to_le_bytes(), &length.to_le_bytes(), &chunk(b"JSON", &text), &chunk(b"BIN\0", &binary)]
        .concat())
}
