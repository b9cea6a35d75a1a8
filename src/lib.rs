//! Online Gaussian-splat SLAM: replays a recorded image sequence and produces a camera trajectory, a photorealistic Gaussian
//! map and honest figures about both. `ARCHITECTURE.md` draws the whole; `CONVENTIONS.md` says what names, frames and units mean.

pub mod bench;
pub mod config;
pub mod evaluation;
pub mod export;
pub mod geometry;
pub mod gpu;
pub mod mapping;
pub mod optimise;
pub mod pipeline;
pub mod reference;
pub mod render;
pub mod report;
pub mod sequence;
pub mod splat;
pub mod stress;
pub mod tracking;
