//! The mapping thread's work: keyframes in, Gaussians seeded, optimised over a sliding window and pruned, snapshots out.
//! Knows nothing of tracking; poses and covisibility arrive with the keyframes.

mod anchors;
mod config;
mod keyframe;
mod mapper;
mod prune;
mod seeding;

pub use config::{MappingConfig, PruneConfig, SeedingConfig, WindowConfig};
pub use keyframe::{Keyframe, KeyframeId};
pub use mapper::{KeyframeReport, Mapper, MappingError};
