//! Threads and their channels: reader → tracker → mapper, bounded, with immutable snapshots out.
//!
//! | message | carried by | when full |
//! |---|---|---|
//! | reader → tracker: [`Frame`](crate::sequence::Frame) | bounded channel | deterministic: blocks; real time: the frame is dropped and counted |
//! | tracker → mapper: [`MapperMessage`](crate::mapping::MapperMessage) | bounded channel | deterministic: blocks; real time: the newest keyframe waits, older ones are counted as deferred |
//! | all → viewers: [`Newest`] values, [`MapSnapshot`](crate::splat::MapSnapshot) among them | one slot each | newest wins |
//! | viewers → mapper: [`RenderOrder`] | bounded queue | refused |
//!
//! No lock is taken on the per-frame path. A panic ends its thread's work; the results so far are returned.

mod attending;
mod control;
mod known_poses;
mod map_thread;
mod newest;
mod outlook;
mod progress;
mod read_thread;
mod refining;
mod run;
mod track_thread;
mod tracked_log;

pub use control::Control;
pub use newest::Newest;
pub use outlook::{Outlook, RunState};
pub use progress::{FrameImage, KeyframePoses, MappingProgress, PipelineError, Progress, RenderOrder, TrackingProgress};
pub use refining::KeptMapper;
pub use run::{Replay, run};
pub use tracked_log::{MappedLog, TrackedLog};
