//! Elements of PLY files (Turk 1994): vertices with positions and colours, ASCII or binary little-endian, and where the faces lie.
//!
//! Left out: big-endian files, and what follows the faces.

use glam::Vec3;

/// Farther from the origin, squares of lengths overflow, metres.
const MOST_COORDINATE: f32 = 1e7;
/// No honest header is longer.
const MOST_HEADER: usize = 1 << 16;
/// The colour of vertices that have none.
const GREY: [u8; 3] = [180; 3];

/// A number's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scalar {
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

    /// Its size.
    pub fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Of bytes that are enough.
    pub fn read(self, bytes: &[u8]) -> f64 {
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
pub(crate) struct Property {
    pub name: String,
    pub kind: Scalar,
    /// Type of its length, for a list.
    pub length: Option<Scalar>,
    offset: usize,
    /// Place among the element's properties.
    index: usize,
}

/// Elements of one kind.
#[derive(Clone, Debug, Default)]
pub(crate) struct Element {
    pub count: usize,
    pub properties: Vec<Property>,
    /// Without lists.
    stride: usize,
}

/// What a file begins with.
#[derive(Debug, Default)]
pub(crate) struct Header {
    vertex: Option<Element>,
    pub face: Option<Element>,
    /// Whether another element follows the faces.
    is_past_faces: bool,
    pub is_ascii: bool,
    bytes: usize,
}

impl Header {
    /// Errors say what is wrong with it.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut header = Self::default();
        let mut has_format = false;
        for (number, line) in bytes[..bytes.len().min(MOST_HEADER)].split_inclusive(|b| *b == b'\n').enumerate() {
            header.bytes += line.len();
            let text = String::from_utf8_lossy(line);
            let words: Vec<&str> = text.split_whitespace().collect();
            match words[..] {
                ["ply"] if number == 0 => {}
                _ if number == 0 => return Err("it does not begin as a PLY file".into()),
                ["format", "binary_little_endian", "1.0"] => has_format = true,
                ["format", "ascii", "1.0"] => (has_format, header.is_ascii) = (true, true),
                ["format", ..] => return Err(format!("line {}: `{}` is not supported", number + 1, text.trim())),
                ["end_header"] if !line.ends_with(b"\n") => return Err("the header has no end".into()),
                ["end_header"] if has_format => return Ok(header),
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
        let (offset, index) = (element.stride, element.properties.len());
        element.properties.push(Property { name: name.into(), kind, length, offset, index });
        element.stride += if length.is_none() { kind.bytes() } else { 0 };
    }
}

/// Vertices in the order of the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Vertices {
    pub positions: Vec<Vec3>,
    /// sRGB.
    pub colors: Vec<[u8; 3]>,
}

impl Vertices {
    /// Those of a file without regard to its faces; errors say what is wrong with it.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        Ok(Self::after(&Header::parse(bytes)?, bytes)?.0)
    }

    /// Those that follow a file's header, and the bytes behind them.
    pub fn after<'a>(header: &Header, bytes: &'a [u8]) -> Result<(Self, &'a [u8]), String> {
        let element = header.vertex.as_ref().ok_or("it has no vertices")?;
        let columns = Columns::of(element)?;
        let body = &bytes[header.bytes..];
        let mut vertices = Self::default();
        if header.is_ascii {
            let text = std::str::from_utf8(body).map_err(|_| "it says that it is ASCII, and is not")?;
            let mut lines = text.lines().filter(|line| !line.trim().is_empty());
            for index in 0..element.count {
                let numbers = numbers(lines.next().ok_or("it is cut off")?, element.properties.len());
                let numbers = numbers.map_err(|what| format!("vertex {index} {what}"))?;
                vertices.push(&columns, |property| numbers[property.index])?;
            }
            return Ok((vertices, &[]));
        }
        let size = element.count.checked_mul(element.stride).filter(|size| *size <= body.len()).ok_or("it is cut off")?;
        let (rows, rest) = body.split_at(size);
        for row in rows.chunks_exact(element.stride) {
            vertices.push(&columns, |property| property.kind.read(&row[property.offset..]))?;
        }
        Ok((vertices, rest))
    }

    fn push(&mut self, columns: &Columns<'_>, value: impl Fn(&Property) -> f64) -> Result<(), String> {
        let p = Vec3::from(columns.position.map(|property| value(property) as f32));
        if !(p.is_finite() && p.abs().max_element() <= MOST_COORDINATE) {
            let index = self.positions.len();
            return Err(format!("vertex {index} is not finite, or farther than 10,000 km from the origin"));
        }
        self.positions.push(p);
        self.colors.push(columns.color.map_or(GREY, |color| color.map(|property| value(property) as u8)));
        Ok(())
    }
}

/// Where a vertex has its position and its colour.
struct Columns<'a> {
    position: [&'a Property; 3],
    color: Option<[&'a Property; 3]>,
}

impl<'a> Columns<'a> {
    fn of(vertex: &'a Element) -> Result<Self, String> {
        let find = |name: &str| vertex.properties.iter().find(|property| property.name == name);
        let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(find) else { return Err("its vertices lack x, y or z".into()) };
        let color = match ["red", "green", "blue"].map(|name| find(name).filter(|property| property.kind == Scalar::U8)) {
            [Some(r), Some(g), Some(b)] => Some([r, g, b]),
            _ => None,
        };
        Ok(Self { position: [x, y, z], color })
    }
}

/// So many numbers in a line of text.
fn numbers(line: &str, count: usize) -> Result<Vec<f64>, String> {
    let parse = |word: &str| word.parse().map_err(|_| format!("has `{word}`, which is no number"));
    let numbers = line.split_whitespace().map(parse).collect::<Result<Vec<f64>, String>>()?;
    if numbers.len() == count { Ok(numbers) } else { Err(format!("has {} of {count} values", numbers.len())) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "element vertex 2\nproperty float x\nproperty double y\nproperty float z\nproperty uint8 red\n\
                          property uint8 green\nproperty uint8 blue\nend_header\n";

    #[test]
    fn points_are_read_from_text_and_from_bytes() {
        let text = format!("ply\nformat ascii 1.0\ncomment of nerfstudio\n{HEADER}0.5 -1 2.25 255 0 7\n\n 3 4e0 5 1 2 3\n");
        let mut bytes = format!("ply\nformat binary_little_endian 1.0\n{HEADER}").into_bytes();
        for (p, color) in [([0.5f32, -1.0, 2.25], [255u8, 0, 7]), ([3.0, 4.0, 5.0], [1, 2, 3])] {
            bytes.extend(p[0].to_le_bytes());
            bytes.extend(f64::from(p[1]).to_le_bytes());
            bytes.extend(p[2].to_le_bytes());
            bytes.extend(color);
        }
        let vertices = Vertices::parse(text.as_bytes()).unwrap();
        assert_eq!(vertices.positions, [Vec3::new(0.5, -1.0, 2.25), Vec3::new(3.0, 4.0, 5.0)]);
        assert_eq!(vertices.colors, [[255, 0, 7], [1, 2, 3]]);
        assert_eq!(Vertices::parse(&bytes).unwrap(), vertices);
        for (wrong, what) in [
            (text.replace(" 5 1 2 3", " 5 1 2"), "vertex 1 has 5 of 6 values"),
            (text.replace("4e0", "four"), "vertex 1 has `four`, which is no number"),
            (text.replace("-1 2.25", "nan 2.25"), "vertex 0 is not finite"),
            (text.replace("vertex 2", "vertex 3"), "cut off"),
            (text.replace("float z", "float w"), "lack x, y or z"),
            (text.replace("ascii", "binary_big_endian"), "is not supported"),
            ("ply\nformat binary_little_endian 1.0\nelement vertex 4\nend_header\n".into(), "lack x, y or z"),
        ] {
            let message = Vertices::parse(wrong.as_bytes()).unwrap_err();
            assert!(message.contains(what), "{message}");
        }
        assert!(Vertices::parse(&bytes[..bytes.len() - 1]).unwrap_err().contains("cut off"));
    }
}
