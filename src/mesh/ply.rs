//! Meshes as binary little-endian PLY (Turk 1994).
//!
//! Reads any such file whose elements are `vertex`, with x, y and z as floats or doubles and colours as bytes, then `face`, with one list of
//! indices. Polygons become fans. Left out: ASCII and big-endian files, and elements beside these two.

use glam::Vec3;

use super::Mesh;

/// Farther from the origin, squares of lengths overflow, metres.
const MOST_COORDINATE: f32 = 1e7;
/// No honest header is longer.
const MOST_HEADER: usize = 1 << 16;
/// The colour of vertices that have none.
const GREY: [u8; 3] = [180; 3];

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

/// A number's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Result<Self, String> {
        Ok(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return Err(format!("`{name}` is no type")),
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Of bytes that are enough.
    fn read(self, bytes: &[u8]) -> f64 {
        macro_rules! of {
            ($kind:ty) => {
                <$kind>::from_le_bytes(bytes[..size_of::<$kind>()].try_into().expect("as many bytes")) as f64
            };
        }
        match self {
            Self::I8 => of!(i8),
            Self::U8 => of!(u8),
            Self::I16 => of!(i16),
            Self::U16 => of!(u16),
            Self::I32 => of!(i32),
            Self::U32 => of!(u32),
            Self::F32 => of!(f32),
            Self::F64 => of!(f64),
        }
    }
}

/// A property, and where it lies in its element.
#[derive(Clone, Debug)]
struct Property {
    name: String,
    kind: Scalar,
    /// Type of its length, for a list.
    length: Option<Scalar>,
    offset: usize,
}

#[derive(Clone, Debug, Default)]
struct Element {
    count: usize,
    properties: Vec<Property>,
    /// Without lists.
    stride: usize,
}

#[derive(Debug, Default)]
struct Header {
    vertex: Option<Element>,
    face: Option<Element>,
    /// Whether another element follows the faces.
    is_past_faces: bool,
    bytes: usize,
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut header = Self::default();
        let mut little_endian = false;
        for (number, line) in bytes[..bytes.len().min(MOST_HEADER)].split_inclusive(|b| *b == b'\n').enumerate() {
            header.bytes += line.len();
            let text = String::from_utf8_lossy(line);
            let words: Vec<&str> = text.split_whitespace().collect();
            match words[..] {
                ["ply"] if number == 0 => {}
                _ if number == 0 => return Err("it does not begin as a PLY file".into()),
                ["format", "binary_little_endian", "1.0"] => little_endian = true,
                ["format", ..] => return Err(format!("line {}: `{}` is not supported", number + 1, text.trim())),
                ["end_header"] if !line.ends_with(b"\n") => return Err("the header has no end".into()),
                ["end_header"] if little_endian => return Ok(header),
                ["end_header"] => return Err("no line says the format".into()),
                [] | ["comment" | "obj_info", ..] => {}
                _ => header.line(&words).map_err(|what| format!("line {}: {what}", number + 1))?,
            }
        }
        Err("the header has no end".into())
    }

    /// A line that describes an element or a property.
    fn line(&mut self, words: &[&str]) -> Result<(), String> {
        let element = |count: &str| {
            let count = count.parse().map_err(|_| format!("`{count}` is no number of elements"))?;
            Ok::<_, String>(Element { count, ..Element::default() })
        };
        match *words {
            ["element", "vertex", count] if self.vertex.is_none() && self.face.is_none() => self.vertex = Some(element(count)?),
            ["element", "face", count] if self.vertex.is_some() && self.face.is_none() => self.face = Some(element(count)?),
            // What follows the faces is not read.
            ["element", ..] if self.face.is_some() => self.is_past_faces = true,
            ["property", ..] if self.is_past_faces => {}
            ["property", ..] if self.vertex.is_none() => return Err("a property without an element".into()),
            ["property", "list", length, kind, name] if self.face.is_some() => {
                self.add(name, Scalar::parse(kind)?, Some(Scalar::parse(length)?));
            }
            ["property", kind, name] => self.add(name, Scalar::parse(kind)?, None),
            _ => return Err(format!("`{}` is not understood", words.join(" "))),
        }
        Ok(())
    }

    fn add(&mut self, name: &str, kind: Scalar, length: Option<Scalar>) {
        let Some(element) = self.face.as_mut().or(self.vertex.as_mut()) else { return };
        element.properties.push(Property { name: name.into(), kind, length, offset: element.stride });
        element.stride += if length.is_none() { kind.bytes() } else { 0 };
    }
}

/// Reads a file; errors say what is wrong with it.
pub(super) fn decode(bytes: &[u8]) -> Result<Mesh, String> {
    let header = Header::parse(bytes)?;
    let vertex = header.vertex.ok_or("it has no vertices")?;
    let face = header.face.ok_or("it has no faces, so it is a map or a cloud of points")?;
    let body = &bytes[header.bytes..];
    let size = vertex.count.checked_mul(vertex.stride).filter(|size| *size <= body.len()).ok_or("it is cut off")?;
    let (vertices, faces) = body.split_at(size);
    let mut mesh = Mesh::default();
    read_vertices(&vertex, vertices, &mut mesh)?;
    read_faces(&face, faces, &mut mesh)?;
    Ok(mesh)
}

fn read_vertices(vertex: &Element, bytes: &[u8], mesh: &mut Mesh) -> Result<(), String> {
    let find = |name: &str| vertex.properties.iter().find(|property| property.name == name);
    let position = ["x", "y", "z"].map(find);
    let [Some(x), Some(y), Some(z)] = position else { return Err("its vertices lack x, y or z".into()) };
    let color = ["red", "green", "blue"].map(|name| find(name).filter(|property| property.kind == Scalar::U8));
    for (index, vertex) in bytes.chunks_exact(vertex.stride).enumerate() {
        let [x, y, z] = [x, y, z].map(|property| property.kind.read(&vertex[property.offset..]) as f32);
        let p = Vec3::new(x, y, z);
        if !(p.is_finite() && p.abs().max_element() <= MOST_COORDINATE) {
            return Err(format!("vertex {index} is not finite, or farther than 10,000 km from the origin"));
        }
        mesh.vertices.push(p);
        mesh.colors.push(match color {
            [Some(r), Some(g), Some(b)] => [r, g, b].map(|property| vertex[property.offset]),
            _ => GREY,
        });
    }
    Ok(())
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
