//! glTF 2.0 binary with `KHR_gaussian_splatting`: Gaussians as points, activated parameters, f32.
//!
//! The extension's ellipse kernel with its linear scales and opacities, as ratified and as three.js reads it. Reads the first primitive of
//! Gaussians, of floats. Left out: quantised attributes, transforms of nodes, compression, files beside the binary.

use std::io::BufRead;
use std::path::Path;

use glam::{Quat, Vec3};
use serde::Deserialize;
use serde_json::{Value, json};

use super::axes::turned;
use super::{ExportError, FileSize, FormatRow};
use crate::splat::sh::SH_C0;
use crate::splat::{Gaussian, GaussianCloud, ShDegree, opacity_from_raw, raw_opacity_from_opacity, unit_rotation};

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "glb",
    extension: "glb",
    help: "glTF binary with KHR_gaussian_splatting, float; engines and three.js read it.",
    keeps_antialiasing: false,
    is_lossless: false,
    tolerance: 5e-5,
    encode: Some(|cloud, _| encode(cloud)),
    decode,
};

const EXTENSION: &str = "KHR_gaussian_splatting";
const MAGIC: u32 = 0x4654_6c67;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;
const FLOAT: u64 = 5126;
/// Extents stay finite.
const LARGEST: Vec3 = Vec3::splat(1e37);
/// Bytes between two elements, at most.
const MOST_STRIDE: usize = 252;
/// Opacities whose logits are finite.
const OPACITIES: (f32, f32) = (1e-6, 1.0 - 1e-6);

/// One attribute: its name, its type, and its floats.
struct Attribute {
    name: String,
    kind: &'static str,
    values: Vec<f32>,
}

fn encode(cloud: &GaussianCloud) -> Result<Vec<u8>, ExportError> {
    if let Some(index) = cloud.first_non_finite() {
        return Err(ExportError::NonFinite { index });
    }
    let cloud = turned(cloud);
    let attributes = attributes(&cloud);
    let binary: Vec<u8> = attributes.iter().flat_map(|a| &a.values).flat_map(|value| value.to_le_bytes()).collect();
    let mut header = json_chunk(&cloud, &attributes, binary.len()).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + header.len() + 8 + binary.len();
    let words = |words: [u32; 2]| words.into_iter().flat_map(u32::to_le_bytes);
    let length = u32::try_from(length).map_err(|_| ExportError::Encode { reason: "a GLB has at most 4 GiB".into() })?;
    let mut bytes: Vec<u8> = words([MAGIC, 2]).chain(length.to_le_bytes()).collect();
    bytes.extend(words([header.len() as u32, JSON_CHUNK]));
    bytes.extend(header);
    bytes.extend(words([binary.len() as u32, BINARY_CHUNK]));
    bytes.extend(binary);
    Ok(bytes)
}

/// Name of the coefficient `k` of the harmonics.
fn harmonic(k: usize) -> String {
    let degree = k.isqrt();
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{}", k - degree * degree)
}

fn attributes(cloud: &GaussianCloud) -> Vec<Attribute> {
    let coefficients = cloud.sh_degree.coefficients();
    let vectors = |name: String, values: &mut dyn Iterator<Item = Vec3>| Attribute {
        name,
        kind: "VEC3",
        values: values.flat_map(|v| v.to_array()).collect(),
    };
    let opacity = |raw: &f32| opacity_from_raw(*raw);
    let color = |(sh, raw): (&[Vec3], &f32)| {
        let [r, g, b] = (sh[0] * SH_C0 + 0.5).clamp(Vec3::ZERO, Vec3::ONE).to_array().map(linear);
        [r, g, b, opacity(raw)]
    };
    let rotations = cloud.rotations.iter().map(|rotation| unit_rotation(*rotation));
    let colors = cloud.sh.chunks(coefficients).zip(&cloud.raw_opacities).flat_map(color);
    let mut all = vec![
        vectors("POSITION".into(), &mut cloud.means.iter().copied()),
        Attribute { name: "COLOR_0".into(), kind: "VEC4", values: colors.collect() },
        Attribute { name: format!("{EXTENSION}:ROTATION"), kind: "VEC4", values: rotations.flat_map(|q| q.to_array()).collect() },
        vectors(format!("{EXTENSION}:SCALE"), &mut cloud.log_scales.iter().map(|scale| scale.exp().min(LARGEST))),
        Attribute {
            name: format!("{EXTENSION}:OPACITY"),
            kind: "SCALAR",
            values: cloud.raw_opacities.iter().map(opacity).collect(),
        },
    ];
    let of = |k: usize| vectors(harmonic(k), &mut cloud.sh.iter().skip(k).step_by(coefficients).copied());
    all.extend((0..coefficients).map(of));
    all
}

/// Of sRGB: the colour of a viewer that shows points only.
fn linear(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

fn json_chunk(cloud: &GaussianCloud, attributes: &[Attribute], bytes: usize) -> Value {
    let corner = |pick: fn(Vec3, Vec3) -> Vec3| cloud.means.iter().copied().reduce(pick).unwrap_or_default().to_array();
    let mut offset = 0;
    let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), serde_json::Map::new());
    for (k, attribute) in attributes.iter().enumerate() {
        let length = 4 * attribute.values.len();
        // 34962: ARRAY_BUFFER.
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": 34962 }));
        let mut accessor = json!({ "bufferView": k, "componentType": FLOAT, "count": cloud.len(), "type": attribute.kind });
        if k == 0 {
            accessor["min"] = json!(corner(Vec3::min));
            accessor["max"] = json!(corner(Vec3::max));
        }
        accessors.push(accessor);
        names.insert(attribute.name.clone(), json!(k));
        offset += length;
    }
    json!({
        "asset": { "version": "2.0", "generator": concat!("keysplat ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "map" }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": names,
            "extensions": { EXTENSION: { "kernel": "ellipse", "colorSpace": "srgb_rec709_display" } }
        }] }],
        "buffers": [{ "byteLength": bytes }],
        "bufferViews": views,
        "accessors": accessors,
    })
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    #[serde(default)]
    nodes: Vec<Value>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    buffer_views: Vec<BufferView>,
    #[serde(default)]
    accessors: Vec<Accessor>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: serde_json::Map<String, Value>,
    #[serde(default)]
    extensions: serde_json::Map<String, Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u64,
    count: usize,
    r#type: String,
}

fn decode(reader: &mut dyn BufRead, FileSize(file_bytes): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let damaged = |what: String| ExportError::Damaged { path: path.into(), what };
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes).map_err(|source| ExportError::Read { path: path.into(), source })?;
    let word = |at: usize| bytes.get(at..at + 4).map(|word| u32::from_le_bytes(word.try_into().expect("four bytes")));
    if word(0) != Some(MAGIC) || word(4) != Some(2) || word(16) != Some(JSON_CHUNK) {
        return Err(damaged("this is no GLB of version 2".into()));
    }
    if word(8).map(u64::from) != Some(file_bytes) {
        return Err(damaged("the file is cut off or longer than its header promises".into()));
    }
    let cut = || damaged("the file is cut off".into());
    let chunk = |at: usize| {
        let length = word(at)? as usize;
        bytes.get(at + 8..(at + 8).checked_add(length)?)
    };
    let json = chunk(12).ok_or_else(cut)?;
    let document: Document = serde_json::from_slice(json).map_err(|error| damaged(format!("its JSON: {error}")))?;
    let binary_at = 20 + json.len();
    let binary = if word(binary_at + 4) == Some(BINARY_CHUNK) { chunk(binary_at).ok_or_else(cut)? } else { &[] };
    document.cloud(binary).map(|cloud| turned(&cloud)).map_err(damaged)
}

impl Document {
    fn cloud(&self, binary: &[u8]) -> Result<GaussianCloud, String> {
        let primitives = self.meshes.iter().flat_map(|mesh| &mesh.primitives);
        let primitive = primitives.into_iter().find(|primitive| primitive.extensions.contains_key(EXTENSION));
        let primitive = primitive.ok_or_else(|| format!("it has no Gaussians ({EXTENSION})"))?;
        let extension = &primitive.extensions[EXTENSION];
        let is = |key: &str, only: &str| extension.get(key).is_none_or(|value| value == only);
        if !is("kernel", "ellipse") || !is("colorSpace", "srgb_rec709_display") {
            return Err("only ellipses in the colours of sRGB are read".into());
        }
        let moves = |node: &Value| ["matrix", "rotation", "translation", "scale"].iter().any(|key| node.get(key).is_some());
        if self.nodes.iter().any(moves) {
            return Err("transforms of nodes are not read; apply them first".into());
        }
        let read = |name: &str, kind: &str| self.floats(primitive, name, kind, binary);
        let own = |name: &str| format!("{EXTENSION}:{name}");
        let positions = read("POSITION", "VEC3")?;
        let (rotations, scales) = (read(&own("ROTATION"), "VEC4")?, read(&own("SCALE"), "VEC3")?);
        let opacities = read(&own("OPACITY"), "SCALAR")?;
        let has = |degree: &&ShDegree| primitive.attributes.contains_key(&harmonic(degree.coefficients() - 1));
        let degree = *ShDegree::ALL.iter().rev().find(has).ok_or("it has no harmonics")?;
        let harmonics = (0..degree.coefficients()).map(|k| read(&harmonic(k), "VEC3")).collect::<Result<Vec<_>, _>>()?;
        let count = opacities.len();
        let fits = positions.len() == 3 * count && rotations.len() == 4 * count && scales.len() == 3 * count;
        if !fits || harmonics.iter().any(|values| values.len() != 3 * count) {
            return Err("its attributes have differing counts".into());
        }
        let mut cloud = GaussianCloud::new(degree);
        for i in 0..count {
            let vector = |values: &[f32]| Vec3::from_slice(&values[3 * i..3 * i + 3]);
            let rotation = Quat::from_slice(&rotations[4 * i..4 * i + 4]);
            let gaussian = Gaussian {
                mean: vector(&positions),
                log_scale: vector(&scales).clamp(Vec3::splat(f32::MIN_POSITIVE), LARGEST).map(f32::ln),
                rotation,
                raw_opacity: raw_opacity_from_opacity(opacities[i].clamp(OPACITIES.0, OPACITIES.1)),
                sh: harmonics.iter().map(|values| vector(values)).collect(),
            };
            if rotation.length_squared() == 0.0 {
                return Err(format!("Gaussian {i} has a rotation without length"));
            }
            cloud.push(gaussian);
        }
        cloud.first_non_finite().map_or(Ok(cloud), |i| Err(format!("Gaussian {i} is not finite")))
    }

    /// The floats of an attribute.
    fn floats(&self, primitive: &Primitive, name: &str, kind: &str, binary: &[u8]) -> Result<Vec<f32>, String> {
        let place = primitive.attributes.get(name).and_then(Value::as_u64).ok_or_else(|| format!("it has no {name}"))?;
        let accessor = self.accessors.get(place as usize).ok_or_else(|| format!("the accessor of {name} is missing"))?;
        if accessor.component_type != FLOAT || accessor.r#type != kind {
            return Err(format!("{name} is no {kind} of floats"));
        }
        let view = accessor.buffer_view.and_then(|view| self.buffer_views.get(view)).filter(|view| view.buffer == 0);
        let view = view.ok_or_else(|| format!("{name} is not in the binary"))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let bytes = end.and_then(|end| binary.get(view.byte_offset..end)).ok_or_else(|| format!("{name} is cut off"))?;
        let components = match kind {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        let stride = view.byte_stride.unwrap_or(4 * components);
        let needed = accessor.count.checked_mul(stride).and_then(|bytes| bytes.checked_add(accessor.byte_offset));
        // The last element may end before its stride does.
        let slack = stride.saturating_sub(4 * components);
        if !(4 * components..=MOST_STRIDE).contains(&stride) || needed.is_none_or(|needed| needed > bytes.len() + slack) {
            return Err(format!("{name} is cut off"));
        }
        let element = |i: usize| (0..components).map(move |c| accessor.byte_offset + i * stride + 4 * c);
        let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        Ok((0..accessor.count).flat_map(element).map(float).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One Gaussian, as the extension's text has it.
    #[test]
    fn a_file_of_others_is_read() {
        let attributes: [(&str, &str, &[f32]); 5] = [
            ("POSITION", "VEC3", &[1.0, 2.0, -3.0]),
            ("KHR_gaussian_splatting:ROTATION", "VEC4", &[0.0, 0.6, 0.0, 0.8]),
            ("KHR_gaussian_splatting:SCALE", "VEC3", &[2.0, 1.0, 0.5]),
            ("KHR_gaussian_splatting:OPACITY", "SCALAR", &[0.75]),
            ("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0", "VEC3", &[0.1, 0.2, 0.3]),
        ];
        let binary: Vec<u8> = attributes.iter().flat_map(|a| a.2).flat_map(|value| value.to_le_bytes()).collect();
        let file = |extension: Value| {
            let mut offset = 0;
            let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), serde_json::Map::new());
            for (k, (name, kind, values)) in attributes.iter().enumerate() {
                views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": 4 * values.len() }));
                accessors.push(json!({ "bufferView": k, "componentType": 5126, "count": 1, "type": kind }));
                names.insert((*name).into(), json!(k));
                offset += 4 * values.len();
            }
            let primitive = json!({ "mode": 0, "attributes": names, "extensions": { "KHR_gaussian_splatting": extension } });
            let document = json!({ "meshes": [{ "primitives": [primitive] }], "bufferViews": views, "accessors": accessors });
            let mut text = document.to_string().into_bytes();
            text.resize(text.len().next_multiple_of(4), b' ');
            let length = (28 + text.len() + binary.len()) as u32;
            let chunk = |name: &[u8], body: &[u8]| [&(body.len() as u32).to_le_bytes(), name, body].concat();
            [b"glTF".as_slice(), &2u32.to_le_bytes(), &length.to_le_bytes(), &chunk(b"JSON", &text), &chunk(b"BIN\0", &binary)]
                .concat()
        };
        let decode = |bytes: &[u8]| decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.glb"));
        let cloud = decode(&file(json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" }))).unwrap();
        let only = cloud.get(0);
        assert_eq!((cloud.len(), only.mean, only.sh), (1, Vec3::new(1.0, -2.0, 3.0), vec![Vec3::new(0.1, 0.2, 0.3)]));
        assert!(only.log_scale.distance(Vec3::new(2f32.ln(), 0.0, 0.5f32.ln())) < 1e-6);
        assert!((only.raw_opacity - 3f32.ln()).abs() < 1e-5 && only.rotation == Quat::from_xyzw(0.0, -0.6, 0.0, 0.8));
        let linear = decode(&file(json!({ "kernel": "ellipse", "colorSpace": "lin_rec709_display" }))).unwrap_err();
        assert!(linear.to_string().contains("sRGB"), "{linear}");
    }

    #[test]
    fn huge_gaussians_stay_finite() {
        let mut cloud = GaussianCloud::new(ShDegree::default());
        let (mean, rotation) = (Vec3::ZERO, Quat::IDENTITY);
        cloud.push(Gaussian { mean, log_scale: Vec3::splat(200.0), rotation, raw_opacity: 60.0, sh: vec![Vec3::ZERO] });
        let bytes = encode(&cloud).unwrap();
        assert_eq!(decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.glb")).unwrap().first_non_finite(), None);
    }
}
