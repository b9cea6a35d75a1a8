//! PLY files (Turk 1994): their header, and vertices with positions and colours, ASCII or binary little-endian.
//!
//! Left out: big-endian files.

use std::io::{BufRead, Read};

use glam::Vec3;

/// Farther from the origin, squares of lengths overflow, metres.
const MOST_COORDINATE: f32 = 1e7;
/// No honest header is longer, bytes. A file without line ends is not read whole in search of one.
const MOST_HEADER: u64 = 1 << 16;
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
    /// Bytes from the start of its element, if no list precedes it.
    offset: usize,
    /// Place among the element's properties.
    index: usize,
}

impl Property {
    /// Its value in the bytes of an element without lists.
    pub fn read(&self, element: &[u8]) -> f64 {
        self.kind.read(&element[self.offset..])
    }
}

/// Elements of one kind.
#[derive(Clone, Debug)]
pub(crate) struct Element {
    pub name: String,
    pub count: usize,
    pub properties: Vec<Property>,
    /// Line of the header that declares it, from 1.
    pub line: usize,
}

impl Element {
    /// Bytes of one; lists, whose length is in the data, are errors.
    pub fn stride(&self) -> Result<usize, String> {
        match self.properties.iter().find(|property| property.length.is_some()) {
            Some(list) => Err(format!("the property `{}` of a {} is a list", list.name, self.name)),
            None => Ok(self.end()),
        }
    }

    /// Where its last property ends.
    fn end(&self) -> usize {
        self.properties.last().map_or(0, |last| last.offset + last.kind.bytes())
    }

    /// Adds a property by the words after `property`.
    fn add(&mut self, words: &[&str]) -> Result<(), String> {
        let (length, kind, name) = match *words {
            ["list", length, kind, name] => (Some(Scalar::parse(length)?), kind, name),
            [kind, name] => (None, kind, name),
            _ => return Err(format!("`property {}` is not understood", words.join(" "))),
        };
        if self.properties.iter().any(|known| known.name == name) {
            return Err(format!("the property `{name}` is there twice"));
        }
        let kind = Scalar::parse(kind)?;
        let property = Property { name: name.into(), kind, length, offset: self.end(), index: self.properties.len() };
        self.properties.push(property);
        Ok(())
    }
}

/// How the numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Ascii,
    BinaryLittleEndian,
}

impl Encoding {
    /// From the words after `format`.
    fn parse(words: &[&str]) -> Option<Self> {
        match words {
            ["ascii", "1.0"] => Some(Self::Ascii),
            ["binary_little_endian", "1.0"] => Some(Self::BinaryLittleEndian),
            _ => None,
        }
    }
}

/// Why a header is of no use.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HeaderError {
    #[error(transparent)]
    Read(#[from] std::io::Error),
    /// Lines count from 1.
    #[error("line {line}: {what}")]
    Text { line: usize, what: String },
}

/// What a file begins with.
#[derive(Debug)]
pub(crate) struct Header {
    /// In the order of their data.
    pub elements: Vec<Element>,
    /// Lines that begin with `comment`, whole.
    pub comments: Vec<String>,
    encoding: Option<Encoding>,
    /// Bytes before the first element's data.
    pub bytes: usize,
    /// Lines, `end_header` among them.
    pub lines: usize,
}

impl Header {
    /// Reads up to the line `end_header`. Encodings that are not accepted are errors.
    pub fn read(reader: &mut dyn BufRead, accepted: &[Encoding]) -> Result<Self, HeaderError> {
        let mut header = Self { elements: Vec::new(), comments: Vec::new(), encoding: None, bytes: 0, lines: 0 };
        let mut reader = reader.take(MOST_HEADER);
        loop {
            let mut line = Vec::new();
            header.bytes += reader.read_until(b'\n', &mut line)?;
            header.lines += 1;
            let text = String::from_utf8_lossy(&line);
            let words: Vec<&str> = text.split_whitespace().collect();
            let read = match words[..] {
                ["ply"] if header.lines == 1 => Ok(()),
                _ if header.lines == 1 => Err("this is no PLY file".into()),
                _ if !line.ends_with(b"\n") => Err("the header has no end".into()),
                ["end_header"] if header.encoding.is_some() => return Ok(header),
                ["end_header"] => Err("no line says the format".into()),
                ["format", ref format @ ..] => {
                    header.encoding = Encoding::parse(format).filter(|encoding| accepted.contains(encoding));
                    header.encoding.map(drop).ok_or_else(|| format!("`{}` is not supported", text.trim()))
                }
                _ => header.line(&words),
            };
            read.map_err(|what| HeaderError::Text { line: header.lines, what })?;
        }
    }

    /// A line that describes an element or a property, or neither.
    fn line(&mut self, words: &[&str]) -> Result<(), String> {
        let text = words.join(" ");
        match *words {
            [] | ["obj_info", ..] => {}
            ["comment", ..] => self.comments.push(text),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("`{count}` is no number of elements"))?;
                self.elements.push(Element { name: name.into(), count, properties: Vec::new(), line: self.lines });
            }
            ["property", ref property @ ..] => match self.elements.last_mut() {
                Some(element) => element.add(property)?,
                None => return Err(format!("`{text}` is not understood")),
            },
            _ => return Err(format!("`{text}` is not understood")),
        }
        Ok(())
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
    /// Those of a file, of which they are the first element; errors say what is wrong with it.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let header = Header::read(&mut &*bytes, &[Encoding::Ascii, Encoding::BinaryLittleEndian]);
        Ok(Self::after(&header.map_err(|error| error.to_string())?, bytes)?.0)
    }

    /// Those that follow a file's header, and the bytes after them.
    pub fn after<'a>(header: &Header, bytes: &'a [u8]) -> Result<(Self, &'a [u8]), String> {
        let element = header.elements.first().filter(|element| element.name == "vertex");
        let element = element.ok_or("it does not begin with vertices")?;
        let stride = element.stride()?;
        let columns = Columns::of(element)?;
        let body = &bytes[header.bytes..];
        let mut vertices = Self::default();
        if header.encoding == Some(Encoding::Ascii) {
            let text = std::str::from_utf8(body).map_err(|_| "it says that it is ASCII, and is not")?;
            let mut lines = text.lines().filter(|line| !line.trim().is_empty());
            for index in 0..element.count {
                let numbers = numbers(lines.next().ok_or("it is cut off")?, element.properties.len());
                let numbers = numbers.map_err(|what| format!("vertex {index} {what}"))?;
                vertices.push(&columns, |property| numbers[property.index])?;
            }
            return Ok((vertices, &[]));
        }
        let size = element.count.checked_mul(stride).filter(|size| *size <= body.len()).ok_or("it is cut off")?;
        let (rows, rest) = body.split_at(size);
        for row in rows.chunks_exact(stride) {
            vertices.push(&columns, |property| property.read(row))?;
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
