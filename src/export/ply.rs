//! The PLY of the 3D Gaussian Splatting reference code (Kerbl et al. 2023): one vertex a Gaussian, raw parameters, f32.
//!
//! Writes binary little endian with the properties in the reference code's order. Reads any binary little-endian PLY whose first
//! element is `vertex` with these properties as floats or doubles, in any order and with others between them. Of degree 4, which others
//! write, it keeps the harmonics up to degree 3.
//! Left out: ASCII and big-endian files, and the compressed variants of some viewers.

use std::io::BufRead;
use std::path::Path;

use glam::{Quat, Vec3};

use super::{ExportError, FileSize, FormatRow};
use crate::files::ply::{Element, Encoding, Header, HeaderError, Property, Scalar};
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

/// Reads a map from a reader of `size` bytes; `path` is named in errors.
fn decode(reader: &mut dyn BufRead, FileSize(file_bytes): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let read_error = |source| ExportError::Read { path: path.into(), source };
    let header_error = |line, what| ExportError::Header { path: path.into(), line, what };
    let header = Header::read(reader, &[Encoding::BinaryLittleEndian]).map_err(|error| match error {
        HeaderError::Read(source) => read_error(source),
        HeaderError::Text { line, what } => header_error(line, what),
    })?;
    let end_error = |what| header_error(header.lines, what);
    let (vertex, others) = header.elements.split_first().ok_or_else(|| end_error("there are no vertices".into()))?;
    if vertex.name != "vertex" {
        return Err(header_error(vertex.line, format!("`element {} {}` comes before the vertices", vertex.name, vertex.count)));
    }
    let stride = vertex.stride().map_err(end_error)?;
    let (sh_degree, properties) = gaussian_properties(vertex).map_err(end_error)?;

    let found = file_bytes.saturating_sub(header.bytes as u64);
    let promised = (vertex.count as u64).checked_mul(stride as u64);
    if !promised.is_some_and(|promised| promised == found || (!others.is_empty() && promised < found)) {
        return Err(ExportError::Length { path: path.into(), vertices: vertex.count as u64, stride, found });
    }

    let antialiased = header.comments.iter().any(|comment| comment == ANTIALIASED);
    let mut cloud = GaussianCloud { antialiased, ..GaussianCloud::new(sh_degree) };
    let mut bytes = vec![0u8; stride];
    let mut values = vec![0.0f32; properties.len()];
    for index in 0..vertex.count {
        reader.read_exact(&mut bytes).map_err(read_error)?;
        for (value, property) in values.iter_mut().zip(&properties) {
            *value = property.read(&bytes) as f32;
            if !value.is_finite() {
                return Err(ExportError::Value { path: path.into(), index, property: property.name.clone(), value: *value });
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

/// A Gaussian's properties in the order of [`property_names`], without the normals; the number of `f_rest` properties gives the degree.
fn gaussian_properties(vertex: &Element) -> Result<(ShDegree, Vec<&Property>), String> {
    let rest = vertex.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    let written = ShDegree::ALL.into_iter().find(|degree| 3 * (degree.coefficients() - 1) == rest);
    let highest = ShDegree::ALL[ShDegree::ALL.len() - 1];
    let sh_degree = written.or((rest == REST_OF_DEGREE_4).then_some(highest));
    let sh_degree = sh_degree.ok_or_else(|| format!("{rest} properties are called f_rest_*, not 0, 9, 24, 45 or 72"))?;
    let kept = sh_degree.coefficients() - 1;
    // Channel by channel in the file, of which each may hold more than are kept.
    let name_in_file = |name: String| match name.strip_prefix("f_rest_").and_then(|number| number.parse::<usize>().ok()) {
        Some(number) => format!("f_rest_{}", number / kept * (rest / 3) + number % kept),
        None => name,
    };
    let wanted = property_names(sh_degree).into_iter().filter(|name| !["nx", "ny", "nz"].contains(&name.as_str()));
    let properties = wanted.map(name_in_file).map(|wanted| match vertex.properties.iter().find(|known| known.name == wanted) {
        Some(property) if matches!(property.kind, Scalar::F32 | Scalar::F64) => Ok(property),
        Some(_) => Err(format!("the property `{wanted}` is not a float")),
        None => Err(format!("the property `{wanted}` is missing")),
    });
    Ok((sh_degree, properties.collect::<Result<_, _>>()?))
}

#[cfg(test)]
#[path = "ply_tests.rs"]
mod tests;
