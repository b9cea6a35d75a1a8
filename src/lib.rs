//! Online Gaussian-splat SLAM: replays a recorded image sequence into a camera trajectory, a Gaussian map and accuracy metrics.
//!
//! A [`Session`] is the one entry to a run: open, run, write, measure. Its example maps a synthetic recording; real ones differ in their path
//! alone. The modules below it are public for programs that track, map, render or evaluate by themselves. `ARCHITECTURE.md` draws the whole,
//! `CONVENTIONS.md` defines frames, units and names.

pub mod calibration;
pub mod config;
pub mod evaluation;
pub mod export;
pub mod files;
pub mod film;
pub mod geometry;
pub mod gpu;
pub mod inspection;
pub mod jobs;
pub mod mapping;
pub mod mesh;
pub mod optimise;
pub mod partition;
pub mod pipeline;
pub mod presets;
pub mod recording;
pub mod render;
pub mod report;
pub mod run_folder;
pub mod sequence;
pub mod session;
pub mod splat;
pub mod synthetic;
pub mod tracking;
pub mod verification;
pub mod viewing;

pub use config::Config;
pub use evaluation::Metrics;
pub use gpu::Gpu;
pub use pipeline::Progress;
pub use presets::Preset;
pub use recording::Recording;
pub use session::{Session, SessionError};
pub use synthetic::SceneConfig;

/// The README's example, compiled with the tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
pub struct Readme;
