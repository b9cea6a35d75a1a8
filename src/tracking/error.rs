//! What can go wrong in tracking, apart from getting lost, which is a state and no error.

/// Errors of the tracker.
#[derive(Debug, thiserror::Error)]
pub enum TrackingError {
    #[error("{0}")]
    Config(String),
    #[error(
        "frame {frame} is the first and has no depth image; the map is started from depth, so begin at a frame that has one \
         or give the recording's depth"
    )]
    FirstFrameWithoutDepth { frame: usize },
    #[error("frame {frame}: its {what} image is {found_width}x{found_height}, but the camera is {width}x{height}")]
    Size { frame: usize, what: &'static str, width: u32, height: u32, found_width: u32, found_height: u32 },
    #[error("the pose of keyframe {keyframe} relative to {relative_to} is refused: {problem}")]
    Measurement { keyframe: usize, relative_to: usize, problem: String },
    #[error("the thread for bundle adjustment could not be started: {0}")]
    Spawn(#[source] std::io::Error),
    #[error("the thread for bundle adjustment panicked; what was tracked until then is kept. Please report this")]
    Adjusting,
    #[error("OpenCV failed while extracting features: {0}")]
    OpenCv(#[from] opencv::Error),
}
