//! The shaders and the mapper against the f64 oracle, and their behaviour at the limits.

#[path = "../common/mod.rs"]
mod common;

mod against_reference;
mod density;
mod embedding;
mod failures;
mod long_optimisation;
mod loop_moves_map;
mod mapper;
mod motion;
mod properties;
mod reference_gradients;
mod scores;
mod shaders;
mod stress;
mod survey;
mod traffic;
