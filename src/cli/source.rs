//! Options that say how a recording is to be read; several subcommands have them.

use clap::Args;
use keysplat::sequence::{Layout, SensorKind};

#[derive(Args, Clone)]
pub struct SourceArgs {
    /// Layout of the recording, where it isn't recognised.
    #[arg(long, value_enum)]
    pub layout: Option<Layout>,
    /// Use of the recording only what a sensor of this kind gives.
    #[arg(long, value_enum)]
    pub sensor: Option<SensorKind>,
    /// Camera preset or path of a camera.toml to use instead of the recording's own calibration. `auto` finds the camera from the first frames, for
    /// recordings that come without one.
    #[arg(long)]
    pub camera: Option<String>,
}
