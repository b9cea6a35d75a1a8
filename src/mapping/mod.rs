//! The mapping thread's work: keyframes in, Gaussians seeded, optimised over a sliding window and pruned, snapshots out.
//! Knows nothing of tracking; poses and covisibility arrive with the keyframes.

mod config;
mod density;
mod keyframe;
mod ledger;
mod mapper;
mod refine_poses;
mod schedule;
mod seeding;

pub use config::{MappingConfig, SeedingConfig, SkipConfig, WindowConfig};
pub use density::{ClassicConfig, DensityConfig, DensityStrategy, VcdConfig};
pub use keyframe::{Keyframe, KeyframeId};
pub use mapper::{KeyframeReport, Mapper, MappingError};
pub use refine_poses::{RefinePosesConfig, RefinedPair};
