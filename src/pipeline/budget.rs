//! What a run may spend, in a word: presets of the configuration, and for real time a resolution that the adapter can afford.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::bench::{BenchScene, StepRunner};
use crate::config::{Config, ConfigError};
use crate::gpu::{Gpu, GpuError};
use crate::render::BlendForm;
use crate::sequence::Sequence;

/// How much time a run may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Budget {
    /// Keeps up with frames that arrive by their timestamps.
    Realtime,
    /// The defaults.
    Balanced,
    /// Finer seeds, more steps, and no tile left out.
    Quality,
}

/// Shares of the recorded resolution that real time may choose.
const SCALES: [f64; 6] = [1.0, 0.75, 0.5, 0.375, 0.25, 0.125];
/// A step should take no longer when it has the machine to itself: beside the tracker and with a grown map it takes three times that, and
/// then some five of them still fit between two keyframes of a walking camera.
const STEP: Duration = Duration::from_millis(15);
/// One Gaussian in view per this many pixels, as seeding gives them.
const PIXELS_EACH: u32 = 8;
/// Neither side is made smaller than this.
const LEAST_PIXELS: u32 = 96;

impl Budget {
    /// Settings in which the budget differs from the defaults.
    pub fn settings(self) -> &'static [&'static str] {
        match self {
            Self::Realtime => &[
                "replay.paced=true",
                "mapping.yields_to_keyframes=true",
                "mapping.first_iterations=10",
                "mapping.iterations_per_keyframe=200",
                "mapping.window.recent=4",
                "mapping.window.covisible=2",
                // Few steps fit between two keyframes, and density control takes as long as some six of them: not after each, and where it
                // comes it comes first, so that no keyframe waits for it.
                "mapping.density.every=5",
                "mapping.density.after_share=0",
                // In so few steps a tile left out of one is hardly seen again.
                "mapping.skip.tile_least=1",
            ],
            Self::Balanced => &[],
            // All tiles gain more than the steps do that take as long.
            Self::Quality => &[
                "mapping.iterations_per_keyframe=40",
                "mapping.skip.tile_least=1",
                "mapping.seeding.detail=0.04",
                "mapping.density.vcd.min_worth=0.5",
            ],
        }
    }

    /// The configuration with this budget's settings.
    ///
    /// # Errors
    /// If they contradict what is set already.
    pub fn apply(self, config: &Config) -> Result<Config, ConfigError> {
        config.with_settings(self.settings())
    }
}

/// The largest share of the recorded resolution at which a training step is quick enough for real time, measured on a scene of about
/// the size that a view will have.
///
/// # Errors
/// If the adapter fails.
pub fn realtime_scale(gpu: &Arc<Gpu>, sequence: &Sequence, config: &Config) -> Result<f64, GpuError> {
    let mut chosen = 1.0;
    for scale in SCALES {
        let pinhole = sequence.camera.pinhole.scaled(scale);
        if scale < 1.0 && pinhole.width.min(pinhole.height) < LEAST_PIXELS {
            break;
        }
        chosen = scale;
        let size = (pinhole.width, pinhole.height);
        let scene = BenchScene::new(gpu, (size.0 * size.1 / PIXELS_EACH) as usize, size, config.mapping.sh_degree)?;
        let wall = StepRunner::new(gpu, scene, BlendForm::of(gpu), None)?.run()?.wall;
        tracing::info!(scale, step_ms = wall.as_secs_f64() * 1e3, "measured a training step");
        if wall <= STEP {
            break;
        }
    }
    Ok(chosen)
}
