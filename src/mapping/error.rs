//! Failures of the mapper.

use std::path::PathBuf;

use super::KeyframeId;
use crate::gpu::GpuError;

/// Failure of the mapper.
#[derive(Debug, thiserror::Error)]
pub enum MappingError {
    /// Failure of the adapter.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// No keyframe has depth to start from.
    #[error("none of the keyframes has depth, neither measured nor of landmarks, and a map can only begin with depth")]
    NoDepth,
    /// The loss of a keyframe is not finite.
    #[error("the loss of keyframe {id} is not finite; please report this with the recording's name and the configuration")]
    NotFinite {
        /// The keyframe.
        id: KeyframeId,
    },
    /// A replayed keyframe differs from the checkpoint's.
    #[error("keyframe {id} comes in another place or another size than before")]
    NotTheSame {
        /// The keyframe.
        id: KeyframeId,
    },
    /// A region with its context does not fit.
    #[error(
        "the adapter has no room for the {gaussians} Gaussians of the region and its context; split the run into smaller cells"
    )]
    NoRoom {
        /// Their number.
        gaussians: usize,
    },
    /// Images that left the GPU cannot be read back.
    #[error(
        "cannot read the images of earlier keyframes back from the temporary folder ({0}); raise --max-host-memory, or set TMPDIR to another folder"
    )]
    Images(#[from] std::io::Error),
    /// Gaussians that left the GPU cannot be read back.
    #[error("{path}, which holds Gaussians that left the GPU, {reason}; raise --max-gpu-memory, or make the run anew")]
    Chunks {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The checkpoint's parts contradict each other.
    #[error("the mapper's state contradicts itself")]
    State,
}
