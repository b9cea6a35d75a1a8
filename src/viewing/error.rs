//! What cannot be shown.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

use crate::export::ExportError;
use crate::geometry::TrajectoryError;

/// What cannot be shown, or not be served.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// Neither a run's folder nor a map.
    #[error("{path} is no folder of a run and no map; give a folder that keysplat run wrote, or a map like map.ply")]
    Nothing {
        /// The path.
        path: PathBuf,
    },
    /// The map cannot be read.
    #[error(transparent)]
    Map(#[from] ExportError),
    /// A trajectory cannot be read.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// The address cannot be listened at.
    #[error("cannot show the run at {address}: {source}; choose another address or port, like --view=127.0.0.1:7008")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The cause.
        source: io::Error,
    },
    /// The system gives no thread or no randomness.
    #[error("cannot start the server of the view: {0}")]
    Start(io::Error),
}
