//! Threads and messages: reader → tracker → mapper, with bounded channels in between and immutable snapshots out.
//!
//! | message | carried by | when full |
//! |---|---|---|
//! | reader → tracker: [`Frame`](crate::sequence::Frame) | bounded channel | unpaced: waits; paced: the frame is dropped and counted |
//! | tracker → mapper: [`MapperMessage`] | bounded channel | unpaced: waits; paced: the newest keyframe waits, older ones are counted as deferred |
//! | mapper → tracker: how the images place keyframes | bounded channel | paced: dropped; unpaced it never is full, and the tracker waits for a fixed keyframe's |
//! | mapper → viewers: [`MapSnapshot`](crate::splat::MapSnapshot) | single-slot queue | newest wins |
//!
//! No lock is taken on the per-frame path. A thread that panics ends its own work; what it had is still returned.

mod budget;
mod checkpoint;
mod heard;
mod history;
mod keeper;
mod known_poses;
mod lock;
mod map_thread;
mod measurements;
mod messages;
pub mod outputs;
mod read_thread;
mod recording;
mod run;
mod track_thread;

pub use budget::{Budget, realtime_scale};
pub use checkpoint::{Checkpoint, CheckpointError};
pub use history::{FrameRecord, History, KeyframeRecord};
pub use keeper::Checkpoints;
pub use known_poses::check_known_poses;
pub use lock::FolderLock;
pub use messages::{MapperMessage, PipelineError, Progress};
pub use recording::{Mapped, Recording, record};
pub use run::{Outcome, check_first_depth, check_size, run};
