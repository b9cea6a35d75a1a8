//! The PLY of the 3D Gaussian Splatting reference code (Kerbl et al. 2023): one vertex a Gaussian, raw parameters, f32.
//!
//! Writes binary little endian with the properties in the reference code's order. Reads any binary little-endian PLY whose first
//! element is `vertex` with these properties as floats or doubles, in any order and with others between them. Of degree 4, which others
//! write, it keeps the harmonics up to degree 3.
//! Left out: ASCII and big-endian files, and the compressed variants of some viewers.

use std::io::{BufRead, Read};
use std::path::Path;

use glam::{Quat, Vec3};

use super::{ExportError, FileSize, FormatRow};
use crate::splat::{Gaussian, GaussianCloud, ShDegree, unit_rotation};

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "ply",
    extension: "ply",
    help: "PLY of the 3D Gaussian Splatting reference code, binary little endian; every viewer reads it.",
    keeps_antialiasing: true,
    is_lossless: true,
    tolerance: 1e-6,
    encode: Some(|cloud, _| encode(cloud)),
    decode,
};

/// The comment that splat-transform, Brush and their like keep of an antialiased map.
const ANTIALIASED: &str = "comment SplatRenderMode: mip";
/// No honest header is longer; a file that has no line ends must not be read whole in search of one.
const MAX_HEADER_BYTES: u64 = 1 << 16;

/// Other programs write harmonics up to degree 4, of which those up to degree 3 are kept.
const REST_OF_DEGREE_4: usize = 3 * 24;

/// The names of the properties, in the order they are written. The file's normals mean nothing and are zero.
fn property_names(sh_degree: ShDegree) -> Vec<String> {
    let rest = 3 * (sh_degree.coefficients() - 1);
    let numbered = |prefix: &'static str, n: usize| (0..n).map(move |i| format!("{prefix}_{i}"));
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned).into();
    names.extend(numbered("f_dc", 3));
    names.extend(numbered("f_rest", rest));
    names.push("opacity".into());
    names.extend(numbered("scale", 3));
    names.extend(numbered("rot", 4));
    names
}

/// The whole file. The same bytes for the same map; rotations are written with unit length.
fn encode(cloud: &GaussianCloud) -> Result<Vec<u8>, ExportError> {
    if let Some(index) = cloud.first_non_finite() {
        return Err(ExportError::NonFinite { index });
    }
    let names = property_names(cloud.sh_degree);
    let comment = if cloud.antialiased { format!("{ANTIALIASED}\n") } else { String::new() };
    let mut header = format!("ply\nformat binary_little_endian 1.0\n{comment}element vertex {}\n", cloud.len());
    for name in &names {
        header.push_str(&format!("property float {name}\n"));
    }
    header.push_str("end_header\n");

    let mut bytes = header.into_bytes();
    bytes.reserve_exact(cloud.len() * names.len() * 4);
    let coefficients = cloud.sh_degree.coefficients();
    for i in 0..cloud.len() {
        let mut put = |value: f32| bytes.extend_from_slice(&value.to_le_bytes());
        let sh = &cloud.sh[i * coefficients..(i + 1) * coefficients];
        cloud.means[i].to_array().into_iter().for_each(&mut put);
        [0.0; 3].into_iter().for_each(&mut put);
        sh[0].to_array().into_iter().for_each(&mut put);
        for channel in 0..3 {
            sh[1..].iter().for_each(|coefficient| put(coefficient[channel]));
        }
        put(cloud.raw_opacities[i]);
        cloud.log_scales[i].to_array().into_iter().for_each(&mut put);
        let [x, y, z, w] = unit_rotation(cloud.rotations[i]).to_array();
        [w, x, y, z].into_iter().for_each(&mut put);
    }
    Ok(bytes)
}

/// Where the values lie in a vertex, bytes from its start.
#[derive(Debug)]
struct VertexLayout {
    vertices: u64,
    stride: usize,
    sh_degree: ShDegree,
    /// Place of each of [`property_names`] but the normals.
    places: Vec<Place>,
    /// Other elements follow the vertices, and more bytes with them.
    more_elements: bool,
}

/// A property of a vertex.
#[derive(Debug)]
struct Place {
    name: String,
    /// Bytes from the vertex' start.
    offset: usize,
    is_double: bool,
}

impl Place {
    fn of(&self, vertex: &[u8]) -> f32 {
        let bytes = &vertex[self.offset..];
        if self.is_double {
            f64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as f32
        } else {
            f32::from_le_bytes(bytes[..4].try_into().expect("four bytes"))
        }
    }
}

/// Reads a map from a reader of `size` bytes; `path` is named in errors.
fn decode(reader: &mut dyn BufRead, FileSize(file_bytes): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let read_error = |source| ExportError::Read { path: path.into(), source };
    let (lines, header_bytes) = header_lines(reader, path)?;
    let layout = parse_header(&lines, path)?;

    let found = file_bytes.saturating_sub(header_bytes);
    let promised = layout.vertices.checked_mul(layout.stride as u64);
    let fits = promised.is_some_and(|promised| promised == found || (layout.more_elements && promised < found));
    let length_error = || ExportError::Length { path: path.into(), vertices: layout.vertices, stride: layout.stride, found };
    let vertices = usize::try_from(layout.vertices).ok().filter(|_| fits).ok_or_else(length_error)?;

    let antialiased = lines.iter().any(|line| line == ANTIALIASED);
    let mut cloud = GaussianCloud { antialiased, ..GaussianCloud::new(layout.sh_degree) };
    let mut vertex = vec![0u8; layout.stride];
    let mut values = vec![0.0f32; layout.places.len()];
    for index in 0..vertices {
        reader.read_exact(&mut vertex).map_err(read_error)?;
        for (value, place) in values.iter_mut().zip(&layout.places) {
            *value = place.of(&vertex);
            if !value.is_finite() {
                return Err(ExportError::Value { path: path.into(), index, property: place.name.clone(), value: *value });
            }
        }
        let gaussian = gaussian_from_values(&values);
        if gaussian.rotation.to_array() == [0.0; 4] {
            return Err(ExportError::Value { path: path.into(), index, property: "rot".into(), value: 0.0 });
        }
        cloud.push(gaussian);
    }
    Ok(cloud)
}

/// From the values in the order of [`property_names`], without the normals.
fn gaussian_from_values(values: &[f32]) -> Gaussian {
    let vector = |at: usize| Vec3::from_slice(&values[at..at + 3]);
    let (sh, tail) = values[3..].split_at(values.len() - 3 - 8);
    let rest = &sh[3..];
    let higher = rest.len() / 3;
    let coefficient = |j: usize| Vec3::new(rest[j], rest[higher + j], rest[2 * higher + j]);
    Gaussian {
        mean: vector(0),
        sh: std::iter::once(vector(3)).chain((0..higher).map(coefficient)).collect(),
        raw_opacity: tail[0],
        log_scale: Vec3::from_slice(&tail[1..4]),
        rotation: Quat::from_xyzw(tail[5], tail[6], tail[7], tail[4]),
    }
}

/// The header's lines up to `end_header`, and how many bytes they took.
fn header_lines(reader: &mut dyn BufRead, path: &Path) -> Result<(Vec<String>, u64), ExportError> {
    let mut limited = reader.take(MAX_HEADER_BYTES);
    let mut lines: Vec<String> = Vec::new();
    loop {
        let mut line = Vec::new();
        let read = limited.read_until(b'\n', &mut line).map_err(|source| ExportError::Read { path: path.into(), source })?;
        let text = String::from_utf8_lossy(&line).trim().to_owned();
        let error = |what: &str| ExportError::Header { path: path.into(), line: lines.len() + 1, what: what.into() };
        if lines.is_empty() && text != "ply" {
            return Err(error("this is no PLY file"));
        }
        if text == "end_header" && line.ends_with(b"\n") {
            return Ok((lines, MAX_HEADER_BYTES - limited.limit()));
        }
        if read == 0 || !line.ends_with(b"\n") {
            return Err(error("the header has no end"));
        }
        lines.push(text);
    }
}

fn parse_header(lines: &[String], path: &Path) -> Result<VertexLayout, ExportError> {
    let mut little_endian = false;
    let mut vertices = None;
    let mut more_elements = false;
    let mut properties: Vec<(String, &str, usize)> = Vec::new();
    let mut stride = 0;
    for (index, text) in lines.iter().enumerate().skip(1) {
        let error = |what: String| ExportError::Header { path: path.into(), line: index + 1, what };
        let words: Vec<&str> = text.split_whitespace().collect();
        match words[..] {
            ["format", "binary_little_endian", "1.0"] => little_endian = true,
            ["format", ..] => return Err(error(format!("`{text}` is not supported"))),
            ["element", "vertex", count] if vertices.is_none() => {
                vertices = Some(count.parse::<u64>().map_err(|_| error(format!("`{count}` is no number of vertices")))?);
            }
            ["element", ..] if vertices.is_some() => more_elements = true,
            ["element", ..] => return Err(error(format!("`{text}` comes before the vertices"))),
            ["property", ..] if more_elements => {}
            ["property", kind, name] if vertices.is_some() => {
                let size = scalar_bytes(kind).ok_or_else(|| error(format!("`{kind}` is no type of a vertex's property")))?;
                if properties.iter().any(|(known, ..)| known == name) {
                    return Err(error(format!("the property `{name}` is there twice")));
                }
                properties.push((name.into(), kind, stride));
                stride += size;
            }
            [] | ["comment" | "obj_info", ..] => {}
            _ => return Err(error(format!("`{text}` is not understood"))),
        }
    }
    let end_error = |what: String| ExportError::Header { path: path.into(), line: lines.len() + 1, what };
    if !little_endian {
        return Err(end_error("no line says the format".into()));
    }
    let vertices = vertices.ok_or_else(|| end_error("there are no vertices".into()))?;
    let (sh_degree, places) = gaussian_places(&properties).map_err(end_error)?;
    Ok(VertexLayout { vertices, stride, sh_degree, places, more_elements })
}

/// Finds a Gaussian's properties among `(name, type, offset)`; the number of `f_rest` properties gives the degree.
fn gaussian_places(properties: &[(String, &str, usize)]) -> Result<(ShDegree, Vec<Place>), String> {
    let rest = properties.iter().filter(|(name, ..)| name.starts_with("f_rest_")).count();
    let written = ShDegree::ALL.into_iter().find(|degree| 3 * (degree.coefficients() - 1) == rest);
    let highest = ShDegree::ALL[ShDegree::ALL.len() - 1];
    let sh_degree = written.or((rest == REST_OF_DEGREE_4).then_some(highest));
    let sh_degree = sh_degree.ok_or_else(|| format!("{rest} properties are called f_rest_*, not 0, 9, 24, 45 or 72"))?;
    let kept = sh_degree.coefficients() - 1;
    // Channel by channel in the file, of which each may hold more than are kept.
    let place_in_file = |name: String| match name.strip_prefix("f_rest_").and_then(|number| number.parse::<usize>().ok()) {
        Some(number) => format!("f_rest_{}", number / kept * (rest / 3) + number % kept),
        None => name,
    };
    let wanted = property_names(sh_degree).into_iter().filter(|name| !["nx", "ny", "nz"].contains(&name.as_str()));
    let places = wanted.map(place_in_file).map(|wanted| match properties.iter().find(|(name, ..)| *name == wanted) {
        Some((_, kind @ ("float" | "float32" | "double" | "float64"), offset)) => {
            Ok(Place { name: wanted, offset: *offset, is_double: kind.ends_with('4') || kind.starts_with('d') })
        }
        Some((_, kind, _)) => Err(format!("the property `{wanted}` is of type {kind}, not a float")),
        None => Err(format!("the property `{wanted}` is missing")),
    });
    Ok((sh_degree, places.collect::<Result<_, _>>()?))
}

fn scalar_bytes(kind: &str) -> Option<usize> {
    match kind {
        "char" | "uchar" | "int8" | "uint8" => Some(1),
        "short" | "ushort" | "int16" | "uint16" => Some(2),
        "int" | "uint" | "int32" | "uint32" | "float" | "float32" => Some(4),
        "double" | "float64" => Some(8),
        _ => None,
    }
}

#[cfg(test)]
#[path = "ply_tests.rs"]
mod tests;
