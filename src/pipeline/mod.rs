//! Threads and their channels: reader → tracker → mapper, bounded, with immutable snapshots out.
//!
//! | message | carried by | when full |
//! |---|---|---|
//! | reader → tracker: [`Frame`](crate::sequence::Frame) | bounded channel | deterministic: blocks; real time: the frame is dropped and counted |
//! | tracker → mapper: [`MapperMessage`](crate::mapping::MapperMessage) | bounded channel | deterministic: blocks; real time: the newest keyframe waits, older ones are counted as deferred |
//! | mapper → tracker: pose feedback | bounded channel | deterministic: never full; real time: dropped |
//! | mapper → viewers: [`MapSnapshot`](crate::splat::MapSnapshot) | single-slot queue | newest wins |
//!
//! No lock is taken on the per-frame path. A panic ends its thread's work; the results so far are returned.

mod known_poses;
mod map_thread;
mod progress;
mod read_thread;
mod run;
mod track_thread;
mod tracked_log;

pub use progress::{PipelineError, Progress, TrackingProgress};
pub use run::{Replay, run};
pub use tracked_log::{MappedLog, TrackedLog};
