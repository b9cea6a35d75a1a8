//! SPZ version 4: the attributes of version 3, each a zstd frame of its own, after a plain header and a table of their lengths.
//!
//! As read and written by `@adobe/spz` (Niantic's code) and gsply 0.4.6. Extensions, which lie before the table, are passed over.

use std::io::{BufRead, Read};
use std::path::Path;

use super::spz::{self, ANTIALIASED, MAGIC, MOST_GAUSSIANS, POSITION_BITS, Packed};
use super::{ExportError, FileSize, FormatRow};
use crate::geometry::Se3;
use crate::splat::{GaussianCloud, ShDegree};

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "spz4",
    help: "SPZ version 4: as version 3 and smaller; newer viewers read it.",
    encode: Some(encode),
    ..spz::FORMAT
};

const VERSION: u32 = 4;
const HEADER: usize = 32;
/// An attribute in the table: its length in the file, and unpacked.
const ROW: usize = 16;
/// Compression level of Niantic's code.
const LEVEL: i32 = 12;
/// A zstd block of four bytes stands for 128 KiB at most.
const MOST_INFLATION: u64 = 1 << 15;
/// Frames may ask for so much memory, as a power of two: twice what that level does.
const WINDOW_LOG: u32 = 24;

fn encode(cloud: &GaussianCloud, cameras: &[Se3]) -> Result<Vec<u8>, ExportError> {
    let Packed { count, degree, bits, flags, attributes } = Packed::new(cloud, cameras)?;
    let attributes = attributes.iter().filter(|attribute| !attribute.is_empty());
    let compress = |attribute: &Vec<u8>| Ok((zstd::bulk::compress(attribute, LEVEL)?, attribute.len()));
    let frames: Result<Vec<(Vec<u8>, usize)>, std::io::Error> = attributes.map(compress).collect();
    let frames = frames.map_err(|error| ExportError::Encode { reason: error.to_string() })?;
    let mut bytes = [MAGIC, VERSION, count].map(u32::to_le_bytes).concat();
    bytes.extend([degree.get(), bits as u8, flags, frames.len() as u8]);
    bytes.extend((HEADER as u32).to_le_bytes());
    bytes.resize(HEADER, 0);
    for (frame, length) in &frames {
        bytes.extend([frame.len() as u64, *length as u64].map(u64::to_le_bytes).concat());
    }
    frames.iter().for_each(|(frame, _)| bytes.extend(frame));
    Ok(bytes)
}

pub(super) fn decode(reader: &mut dyn BufRead, FileSize(size): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let mut bytes = Vec::new();
    reader.take(size).read_to_end(&mut bytes).map_err(|source| ExportError::Read { path: path.into(), source })?;
    unpacked(&bytes).map_err(|what| ExportError::Damaged { path: path.into(), what })
}

fn unpacked(bytes: &[u8]) -> Result<GaussianCloud, String> {
    let cut = || "the file is cut off".to_owned();
    let header = bytes.get(..HEADER).ok_or_else(cut)?;
    let word = |at: usize| u32::from_le_bytes(header[at..at + 4].try_into().expect("four bytes"));
    let (version, count, table) = (word(4), u64::from(word(8)), word(16) as usize);
    let degree = ShDegree::new(header[12]).filter(|_| version == VERSION);
    let degree = degree.ok_or_else(|| format!("version {version} of degree {} is not read", header[12]))?;
    let (bits, streams) = (i32::from(header[13]), usize::from(header[15]));
    if bits >= POSITION_BITS {
        return Err(format!("{bits} of a position's 24 bits cannot be behind the point"));
    }
    let lengths: Vec<u64> = Packed::lengths(count, degree).into_iter().filter(|length| *length > 0).collect();
    let all = lengths.iter().sum::<u64>();
    if count > MOST_GAUSSIANS {
        return Err(format!("{count} Gaussians are promised; at most {MOST_GAUSSIANS} are read"));
    }
    if all > (bytes.len() as u64).saturating_mul(MOST_INFLATION) || table < HEADER {
        return Err(format!("{count} Gaussians are promised, but the file is cut off or longer"));
    }
    if streams != lengths.len() {
        return Err(format!("there are {streams} attributes, not {}", lengths.len()));
    }
    let rows = bytes.get(table..).and_then(|rest| rest.get(..streams * ROW)).ok_or_else(cut)?;
    let mut frames = &bytes[table + streams * ROW..];
    let mut attributes = Vec::new();
    for (row, length) in rows.chunks(ROW).zip(lengths) {
        let number = |at: usize| u64::from_le_bytes(row[at..at + 8].try_into().expect("eight bytes"));
        let frame = usize::try_from(number(0)).ok().and_then(|own| frames.split_at_checked(own));
        let (frame, rest) = frame.ok_or_else(cut)?;
        frames = rest;
        let wrong = |error: std::io::Error| format!("an attribute cannot be unpacked: {error}");
        let mut decoder = zstd::Decoder::with_buffer(frame).map_err(wrong)?;
        decoder.window_log_max(WINDOW_LOG).map_err(wrong)?;
        let before = attributes.len() as u64;
        decoder.take(length + 1).read_to_end(&mut attributes).map_err(wrong)?;
        if number(8) != length || attributes.len() as u64 - before != length {
            return Err(format!("an attribute of {length} bytes has another length"));
        }
    }
    if !frames.is_empty() {
        return Err("bytes follow the last attribute".into());
    }
    let cloud = spz::unpack(&attributes, count as usize, VERSION, degree, bits);
    Ok(GaussianCloud { antialiased: header[14] & ANTIALIASED != 0, ..cloud })
}

#[cfg(test)]
mod tests {
    use super::super::tests::cloud;
    use super::*;

    #[test]
    fn both_versions_hold_the_same_map() {
        let read = |bytes: &[u8]| spz::decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.spz"));
        for degree in ShDegree::ALL {
            let map = cloud(degree, 50);
            let bytes = encode(&map, &[]).unwrap();
            assert_eq!(bytes[..8], [0x4e, 0x47, 0x53, 0x50, 4, 0, 0, 0]);
            let encode_as_3 = spz::FORMAT.encode.unwrap();
            assert_eq!(read(&bytes).unwrap(), read(&encode_as_3(&map, &[]).unwrap()).unwrap());
            // With an extension before the table.
            let mut longer = [&bytes[..HEADER], &[7; 24], &bytes[HEADER..]].concat();
            longer[16] += 24;
            assert_eq!(read(&longer).unwrap(), read(&bytes).unwrap());
        }
        let bytes = encode(&cloud(ShDegree::ALL[1], 50), &[]).unwrap();
        let refusal = |at: usize, value: &[u8]| {
            let mut lie = bytes.clone();
            lie[at..at + value.len()].copy_from_slice(value);
            read(&lie).unwrap_err().to_string()
        };
        assert!(refusal(8, &u32::MAX.to_le_bytes()).contains("4294967295 Gaussians are promised; at most"));
        assert!(refusal(8, &9_999_999u32.to_le_bytes()).contains("9999999 Gaussians are promised, but"));
        let mut equal = GaussianCloud::new(ShDegree::ALL[3]);
        (0..10_000).for_each(|_| equal.push(cloud(ShDegree::ALL[3], 1).get(0)));
        assert_eq!(read(&encode(&equal, &[]).unwrap()).unwrap().len(), 10_000);
        assert!(refusal(8, &[51]).contains("another length"));
        assert!(refusal(15, &[5]).contains("5 attributes, not 6"));
        assert!(refusal(12, &[4]).contains("degree 4"));
        assert!(refusal(13, &[24]).contains("24 of a position's 24 bits"));
        assert!(refusal(16, &u32::MAX.to_le_bytes()).contains("cut off"));
        assert!(refusal(32, &u64::MAX.to_le_bytes()).contains("cut off"));
        assert!(refusal(40, &u64::MAX.to_le_bytes()).contains("another length"));
        assert!(refusal(128, &[0; 8]).contains("cannot be unpacked"));
        assert!(read(&[bytes.clone(), vec![0]].concat()).unwrap_err().to_string().contains("bytes follow"));
    }
}
