//! The mapping thread's work: keyframes in, Gaussians seeded, optimised over a sliding window and pruned, snapshots out.
//! A refinement over all keyframes may follow. Knows nothing of tracking; poses and covisibility arrive with the keyframes.

mod config;
mod density;
mod exposure;
mod keyframe;
mod ledger;
mod limits;
mod mapper;
mod message;
mod neighbours;
mod plane_sweep;
mod points;
mod refine_poses;
mod schedule;
mod seeding;

pub use config::{MappingConfig, PointsConfig, RefineConfig, SeedingConfig, SkipConfig, WindowConfig};
pub use density::{ClassicConfig, DensityConfig, DensityStrategy, VcdConfig};
pub use exposure::ExposureConfig;
pub use keyframe::{DepthSource, Keyframe, KeyframeId, RightImage};
pub use limits::LimitsConfig;
pub use mapper::{KeyframeReport, Mapper, MapperState, MappingError, RefineReport, Refinement};
pub use message::MapperMessage;
pub use plane_sweep::PlaneSweepConfig;
pub use refine_poses::{RefinePosesConfig, RefinedPair};
