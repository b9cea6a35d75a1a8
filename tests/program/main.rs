//! The whole program: runs, resumption, bad input, faults, reports.

#[path = "../common/mod.rs"]
mod common;

mod bad_input;
mod cells;
mod check;
mod datasets;
mod end_to_end;
mod export;
mod faults;
mod film;
mod interaction;
mod jobs;
mod known_poses;
mod mesh;
mod quality;
mod report;
mod resume;
mod sweep;
mod viewing;
