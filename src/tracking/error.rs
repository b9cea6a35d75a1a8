//! What can go wrong in tracking, apart from getting lost, which is a state and no error.

/// Errors of the tracker.
#[derive(Debug, thiserror::Error)]
pub enum TrackingError {
    /// A setting out of its range.
    #[error("{0}")]
    Config(String),
    /// An RGB-D recording begins without depth.
    #[error(
        "frame {frame} is the first and has no depth image; the map is started from depth, so begin at a frame that has one \
         or give the recording's depth"
    )]
    FirstFrameWithoutDepth {
        /// Frame of the replay, from 0.
        frame: usize,
    },
    /// An image's size is not the camera's.
    #[error("frame {frame}: its {what} image is {found_width}x{found_height}, but the camera is {width}x{height}")]
    Size {
        /// Frame of the replay, from 0.
        frame: usize,
        /// `colour` or `depth`.
        what: &'static str,
        /// Expected pixels.
        width: u32,
        /// Expected pixels.
        height: u32,
        /// Pixels.
        found_width: u32,
        /// Pixels.
        found_height: u32,
    },
    /// The system gave no thread.
    #[error("a thread of the tracker could not be started: {0}")]
    Spawn(#[source] std::io::Error),
    /// A solver thread panicked.
    #[error("a thread of the tracker panicked; what was tracked until then is kept. Please report this")]
    Adjusting,
    /// OpenCV failed.
    #[error("OpenCV failed while extracting features: {0}")]
    OpenCv(#[from] opencv::Error),
}
