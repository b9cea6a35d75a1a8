//! A map as a moving picture: camera paths along a run, and files of the frames.

mod encode;
mod path;

pub use encode::{Film, FilmError};
pub use path::{CameraPathKind, poses};
