//! The layouts' text and binary files given as bytes: what the fuzz targets and `tests/hostile_files.rs` feed.

use std::io::Cursor;
use std::path::Path;

use super::colmap::binary::{self, Records};
use super::colmap::{self, text};
use super::video::container::Container;
use super::{Layout, SequenceError, euroc, images, kitti, replica, transforms, tum};
use crate::geometry::Se3;

/// Frames that the files are taken to be of.
const FRAMES: usize = 3;
const SIZE: (u32, u32) = (8, 6);

impl Layout {
    /// Reads `bytes` as each kind of file that this layout has, in turn: what became of each. Images, and videos behind their
    /// containers' headers, are left to their decoders.
    pub fn parse_files(self, bytes: &[u8]) -> Vec<Result<(), SequenceError>> {
        let path = Path::new("file");
        let utf8 = |e| SequenceError::Read { path: path.into(), source: std::io::Error::new(std::io::ErrorKind::InvalidData, e) };
        let text = std::str::from_utf8(bytes).map_err(utf8);
        let io = |source| SequenceError::Read { path: path.into(), source };
        let text = match (self, text) {
            (Self::Video, _) => {
                let is_cut = |container: Container| container.is_cut(Cursor::new(bytes)).map_err(io);
                let container = Container::of(bytes).map_err(io).map(|container| container.map(is_cut));
                return vec![container.and_then(|is_cut| is_cut.transpose().map(drop))];
            }
            (Self::Colmap, text) => return parse_colmap(bytes, text),
            (_, Err(error)) => return vec![Err(error)],
            (_, Ok(text)) => text,
        };
        match self {
            Self::Tum => vec![tum::parse_list(text, path).map(drop), tum::parse_camera(text, path).map(drop)],
            Self::Kitti => {
                let projection = kitti::Calibration::parse(text, path).and_then(|c| c.of("P0", 0).map(drop));
                let poses = kitti::parse_poses(text, path, &[0.0; FRAMES]).map(drop);
                vec![projection, kitti::parse_times(text, path, FRAMES).map(drop), poses]
            }
            Self::Euroc => vec![
                euroc::parse_sensor(text, path).map(drop),
                euroc::parse_rows(text, path).map(drop),
                euroc::parse_truth(text, path, &Se3::identity()).map(drop),
            ],
            Self::Replica => {
                let frames: Vec<usize> = (0..FRAMES).collect();
                vec![replica::parse_camera(text, path).map(drop), replica::parse_poses(text, path, frames.iter()).map(drop)]
            }
            Self::Transforms => {
                let what = |what| SequenceError::Content { path: path.into(), what };
                vec![transforms::Transforms::parse(text, path).and_then(|file| file.lens.camera(SIZE).map(drop).map_err(what))]
            }
            Self::Images => vec![images::parse_camera(text, path).map(drop)],
            Self::Colmap | Self::Video => unreachable!("they are not text alone"),
        }
    }
}

/// The three parts of a model, each as text and as binary.
fn parse_colmap(bytes: &[u8], text: Result<&str, SequenceError>) -> Vec<Result<(), SequenceError>> {
    let path = Path::new("file");
    let records = || Records::new(Cursor::new(bytes), bytes.len() as u64, path);
    let known = |cameras: Vec<colmap::ModelCamera>| cameras.iter().for_each(|camera| drop(colmap::camera_of(camera)));
    let mut results =
        vec![binary::cameras(records()).map(known), binary::images(records()).map(drop), binary::points(records()).map(drop)];
    match text {
        Ok(text) => results.extend([
            text::cameras(text, path).map(known),
            text::images(text, path).map(drop),
            text::points(text, path).map(drop),
        ]),
        Err(error) => results.push(Err(error)),
    }
    results
}
