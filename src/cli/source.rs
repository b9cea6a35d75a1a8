//! Options that say how a recording is to be read; several subcommands have them.

use clap::Args;
use keysplat::sequence::{Layout, SensorKind};

#[derive(Args)]
pub struct SourceArgs {
    /// Layout of the recording, where it isn't recognised.
    #[arg(long, value_enum)]
    pub layout: Option<Layout>,
    /// Use of the recording only what a sensor of this kind gives.
    #[arg(long, value_enum)]
    pub sensor: Option<SensorKind>,
    /// Camera preset to use instead of the recording's own calibration; for a video, or the path of a camera.toml.
    #[arg(long)]
    pub camera: Option<String>,
}
