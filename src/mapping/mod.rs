//! The mapping thread's work: keyframes in, Gaussians inserted, optimised over a sliding window and pruned, snapshots out.
//! A refinement over all keyframes may follow. Knows nothing of tracking; poses and covisibility arrive with the keyframes.

mod anchors;
mod chunks;
mod config;
mod density;
mod error;
mod exposure;
mod host_time;
mod image_store;
mod initialise_from_points;
mod insertion;
mod keyframe;
mod knn;
mod limits;
mod mapper;
mod message;
mod plane_sweep;
mod schedule;

pub use chunks::PagingFigures;
pub use config::{InsertionConfig, MappingConfig, PointsConfig, RefineConfig, WindowConfig};
pub use density::{ClassicConfig, DensityConfig, DensityStrategy, MultiViewConfig};
pub use error::MappingError;
pub use exposure::ExposureConfig;
pub use host_time::HostTimes;
pub use keyframe::{DepthSource, Keyframe, RightImage};
pub use limits::LimitsConfig;
pub use mapper::{FinalRefinement, Interlude, KeyframeReport, Mapper, MapperState, PagedOut, RefineReport};
pub use message::{InitialMap, MapperMessage, PoseUpdate};
pub use plane_sweep::PlaneSweepConfig;

/// Index of a keyframe's frame in the replay; unique and ascending.
pub type KeyframeId = usize;
