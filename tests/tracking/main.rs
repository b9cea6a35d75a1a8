//! The tracker on recordings, its metrics against evo, and solver regressions.

#[path = "../common/mod.rs"]
mod common;

mod evo;
mod recordings;
mod regression;
mod self_calibration;
mod walks;
