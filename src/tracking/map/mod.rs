//! The sparse map: keyframes, landmarks and covisibility; their creation, fusion and culling.

pub mod insertion;
pub mod keyframe;
pub mod keyframe_culling;
pub mod keyframe_database;
pub mod landmark;
pub mod prediction;
pub mod sparse_map;
pub mod tally;
pub mod triangulation;

pub use sparse_map::Map;
