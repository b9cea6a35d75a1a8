//! Errors of recordings; each names its file.

use std::path::PathBuf;

use crate::geometry::TrajectoryError;
use crate::sequence::{Layout, SensorKind, cameras};

/// A recording that cannot be opened or read.
#[derive(Debug, thiserror::Error)]
pub enum SequenceError {
    /// There is no such file or folder.
    #[error("there is no folder or video {0}; give the folder that holds the recording, or its video")]
    Missing(PathBuf),
    /// No dataset layout matches the folder.
    #[error("{0} is no recording in a layout that we know ({known}); check the folder, or name its layout with --layout", known = Layout::known())]
    UnknownLayout(PathBuf),
    /// The file is no video.
    #[error("{path} is no video that we know (MP4, MOV, AVI, MKV, WebM); give one, or give the folder that holds the recording")]
    NoVideo {
        /// The file or folder.
        path: PathBuf,
    },
    /// A frame of the video cannot be decoded.
    #[error("frame {frame} of {path} cannot be decoded; the video is damaged, or was not copied whole")]
    VideoFrame {
        /// The file or folder.
        path: PathBuf,
        /// Frame of the replay, from 0.
        frame: usize,
    },
    /// The recording lacks the requested sensor.
    #[error("{name} is a {found} recording and cannot be replayed as {wanted}; leave --sensor out, or say mono")]
    NoSuchSensor {
        /// Name of the recording.
        name: String,
        /// Requested sensor.
        wanted: SensorKind,
        /// Sensor of the recording.
        found: SensorKind,
    },
    /// A file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A line of a list cannot be parsed.
    #[error("{path}:{line}: {what}")]
    Syntax {
        /// The file or folder.
        path: PathBuf,
        /// Line in the file, from 1.
        line: usize,
        /// What is wrong.
        what: String,
    },
    /// A file contradicts its format.
    #[error("{path}: {what}")]
    Content {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The recording has no frame.
    #[error("{path} lists no frames; check that the recording was copied whole")]
    Empty {
        /// The file or folder.
        path: PathBuf,
    },
    /// A list names an image that does not exist.
    #[error("{list}:{line}: there is no file {image}; check that the recording was copied whole")]
    MissingImage {
        /// The list.
        list: PathBuf,
        /// Line in the file, from 1.
        line: usize,
        /// The image that does not exist.
        image: PathBuf,
    },
    /// Most images of a list do not exist.
    #[error(
        "{list}: {missing} of {listed} listed images are missing, among them {example}; check that the recording was copied whole"
    )]
    MissingImages {
        /// The list.
        list: PathBuf,
        /// Listed images that do not exist.
        missing: usize,
        /// Listed images.
        listed: usize,
        /// The first missing image, as it is listed.
        example: String,
    },
    /// The recording comes without a calibration.
    #[error("{folder}: no camera.txt, and the folder's name says no known camera ({known}); add camera.txt with `fx fy cx cy width height depth_units_per_metre k1 k2 p1 p2`, name one with --camera, or let it be found with --camera auto", known = cameras::names().join(", "))]
    NoCamera {
        /// The recording.
        folder: PathBuf,
    },
    /// No preset has that name, and no file either.
    #[error("no camera is called `{name}`; known are {known}; for a video, give the path of a camera.toml", known = cameras::names().join(", "))]
    UnknownCamera {
        /// The name given.
        name: String,
    },
    /// A camera is named for a recording that has its own.
    #[error("{folder}: recordings in the layout {layout} have their own calibration, which is always used; leave --camera out")]
    OwnCamera {
        /// The recording.
        folder: PathBuf,
        /// Name of its layout.
        layout: &'static str,
    },
    /// An image's size is not the camera's.
    #[error("{path} is {found_width}x{found_height}, but the camera is {width}x{height}; images, depth and camera must agree")]
    Size {
        /// The file or folder.
        path: PathBuf,
        /// Expected pixels.
        width: u32,
        /// Expected pixels.
        height: u32,
        /// Pixels.
        found_width: u32,
        /// Pixels.
        found_height: u32,
    },
    /// An image cannot be decoded.
    #[error("cannot decode {path}: {source}")]
    Image {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: image::ImageError,
    },
    /// A depth image is not 16-bit grey.
    #[error("{path} is no 16-bit grey image; depth must be one")]
    DepthFormat {
        /// The file or folder.
        path: PathBuf,
    },
    /// No frame is in the range selected.
    #[error("frames {start}..{end} is outside the sequence of {len} frames; give --frames A..B within 0..{len}")]
    Range {
        /// First frame selected.
        start: usize,
        /// Frame after the last one selected.
        end: usize,
        /// Frames of the recording.
        len: usize,
    },
    /// The ground truth cannot be read.
    #[error(transparent)]
    Groundtruth(#[from] TrajectoryError),
}
