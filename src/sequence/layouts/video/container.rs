//! What a video's first bytes say about its file, before a decoder sees it: whether it is a video at all, and whether all of it is there.
//!
//! Decoders open nearly anything, a picture as a video of one frame, text as a terminal's screen. Here only the containers that cameras
//! write are let through: MP4 and QuickTime (ISO/IEC 14496-12), AVI (RIFF), Matroska and WebM (RFC 8794 has their first bytes).

use std::io::{self, Read, Seek, SeekFrom};

/// How the bytes of a video are wrapped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Container {
    /// MP4 and QuickTime.
    Boxes,
    /// AVI.
    Riff,
    /// Matroska and WebM.
    Matroska,
}

/// Types of the boxes that these files begin with; QuickTime's early ones lack `ftyp`.
const FIRST_BOXES: [&[u8]; 6] = [b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"];

impl Container {
    /// The container of a file, `None` where it is none of those that we know.
    pub fn of(file: impl Read) -> io::Result<Option<Self>> {
        let mut head = Vec::with_capacity(12);
        file.take(12).read_to_end(&mut head)?;
        let part = |range: std::ops::Range<usize>| head.get(range).unwrap_or_default();
        Ok(if FIRST_BOXES.contains(&part(4..8)) {
            Some(Self::Boxes)
        } else if part(0..4) == b"RIFF" && part(8..12) == b"AVI " {
            Some(Self::Riff)
        } else if part(0..4) == b"\x1a\x45\xdf\xa3" {
            Some(Self::Matroska)
        } else {
            None
        })
    }

    /// Whether the file ends before its container says that it does. Matroska, which may leave lengths open, is never found cut.
    pub fn is_cut(self, mut file: impl Read + Seek) -> io::Result<bool> {
        let length = file.seek(SeekFrom::End(0))?;
        let mut at = 0u64;
        while at < length {
            file.seek(SeekFrom::Start(at))?;
            let mut head = [0; 16];
            if io::copy(&mut (&mut file).take(16), &mut head.as_mut_slice())? < 8 {
                return Ok(false);
            }
            match self.part_length(&head) {
                Some(part) => at = at.saturating_add(part),
                None => return Ok(false),
            }
        }
        Ok(at > length)
    }

    /// The length in bytes of the outermost part that begins with `head`, `None` where it says none.
    fn part_length(self, head: &[u8; 16]) -> Option<u64> {
        let [a, b, c, d, e, f, g, h, long @ ..] = *head;
        let length = match self {
            Self::Boxes => match u32::from_be_bytes([a, b, c, d]) {
                1 => u64::from_be_bytes(long),
                short => short.into(),
            },
            // Padded to an even length. What follows the last one, if anything, is not ours to judge.
            Self::Riff if &head[..4] == b"RIFF" => 8 + u64::from(u32::from_le_bytes([e, f, g, h])).next_multiple_of(2),
            Self::Riff | Self::Matroska => return None,
        };
        (length >= 8).then_some(length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Container of a file with these bytes, and whether the file is cut.
    fn found(bytes: &[u8]) -> Option<(Container, bool)> {
        let container = Container::of(bytes).unwrap()?;
        Some((container, container.is_cut(io::Cursor::new(bytes)).unwrap()))
    }

    #[test]
    fn containers_are_known_by_their_bytes_and_their_ends() {
        let boxes = b"\0\0\0\x0cftypisom\0\0\0\x01mdat\0\0\0\0\0\0\0\x12..";
        assert_eq!(found(boxes), Some((Container::Boxes, false)));
        assert_eq!(found(&boxes[..boxes.len() - 1]), Some((Container::Boxes, true)));
        assert_eq!(found(b"\0\0\0\0mdat..."), Some((Container::Boxes, false)), "to the end, however long");
        let riff = b"RIFF\x05\0\0\0AVI .\0RIFF\x04\0\0\0AVIX";
        assert_eq!(found(riff), Some((Container::Riff, false)));
        assert_eq!(found(&riff[..riff.len() - 1]), Some((Container::Riff, true)));
        assert_eq!(found(b"\x1a\x45\xdf\xa3....").map(|found| found.0), Some(Container::Matroska));
        assert_eq!(found(b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR"), None);
        assert_eq!(found(b"RIFF\x04\0\0\0WAVE"), None);
        assert_eq!(found(b""), None);
    }
}
