//! The shaders and the mapper against the f64 oracle, and their behaviour at the limits.

#[path = "../common/mod.rs"]
mod common;

mod against_reference;
mod antialiasing;
mod density;
mod embedding;
mod failures;
mod lists;
mod long_optimisation;
mod loop_moves_map;
mod mapper;
mod motion;
mod oracle;
mod paging;
mod properties;
mod reference_gradients;
mod scores;
mod shaders;
mod stress;
mod surfaces;
mod survey;
mod traffic;
