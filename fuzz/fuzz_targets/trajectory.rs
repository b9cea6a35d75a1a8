//! Trajectories in TUM's text, ours and others'. What is read is written and read again.
#![no_main]

use std::path::Path;

use keysplat::geometry::Trajectory;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(trajectory) = Trajectory::parse_tum(text, Path::new("file")) {
        drop(Trajectory::parse_tum(&trajectory.to_tum(), Path::new("again")));
    }
});
