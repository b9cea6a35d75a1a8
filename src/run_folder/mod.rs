//! The folder of a run: results, metrics, records, checkpoint and lock.

mod checkpoint;
mod checkpointer;
mod history;
mod lock;
mod map_file;
mod message_digest;
pub mod outputs;
mod result;

pub use checkpoint::{Checkpoint, CheckpointError};
pub(crate) use checkpoint::{Elapsed, RunState};
pub use checkpointer::Checkpointer;
pub use history::{FrameRecord, History, KeyframeRecord};
pub use lock::FolderLock;
pub use outputs::OutputError;
pub use result::RunResult;
pub(crate) use result::{exposures, image_exposures};
