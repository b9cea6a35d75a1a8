//! The row of a dataset layout.

use std::path::Path;

use crate::sequence::{Sequence, SequenceError};

/// Frames and image size (pixels) that sample files are parsed for, where a parser needs them.
pub const SAMPLE_FRAMES: usize = 3;
pub const SAMPLE_SIZE: (u32, u32) = (8, 6);

/// Results of parsing the same bytes as each kind of file of a layout.
pub type Parsed = Vec<Result<(), SequenceError>>;

/// A dataset layout: recognition, reader and parser.
pub struct LayoutRow {
    /// Name on the command line and in configurations.
    pub name: &'static str,
    /// Files that identify it, for messages.
    pub marker: &'static str,
    /// One sentence for `--help`.
    pub help: &'static str,
    /// Whether its frames are photos with known poses, each a keyframe, instead of frames of a moving camera.
    pub is_photos: bool,
    /// Whether a camera may be named; else a recording has its own.
    pub takes_camera: bool,
    /// Whether a folder has the marker files.
    pub recognise: fn(&Path) -> bool,
    /// Opens a folder, or a video, with the camera of a name, where the layout takes one.
    pub open: fn(&Path, Option<&str>) -> Result<Sequence, SequenceError>,
    /// Parses bytes as each kind of file of the layout, for the fuzz target. Images are left to their decoders.
    pub parse: fn(&[u8]) -> Parsed,
}

/// Parses bytes as text files of a layout; the one result where they are no UTF-8.
pub fn parse_text(bytes: &[u8], parse: impl Fn(&str, &Path) -> Parsed) -> Parsed {
    let path = Path::new("file");
    match std::str::from_utf8(bytes) {
        Ok(text) => parse(text, path),
        Err(error) => {
            let source = std::io::Error::new(std::io::ErrorKind::InvalidData, error);
            vec![Err(SequenceError::Read { path: path.into(), source })]
        }
    }
}
