//! Presets of the configuration, and the mapping resolution at which an adapter keeps up with a camera.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::calibration::{BenchScene, StepRunner};
use crate::config::Config;
use crate::gpu::{AdapterSummary, Gpu, GpuError};
use crate::recording::Recording;
use crate::render::BlendForm;

/// A named set of configuration values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Keep up with the recording's own frame rate: resolution and steps follow from the adapter's speed.
    Realtime,
    /// Few steps: 2 a keyframe, and 5 epochs at the end.
    Draft,
    /// The defaults.
    Balanced,
    /// More steps over all keyframes, and denser insertion.
    Quality,
    /// The same with more steps.
    Best,
}

impl Preset {
    /// All presets, the fastest one first.
    pub const ALL: [Self; 5] = [Self::Realtime, Self::Draft, Self::Balanced, Self::Quality, Self::Best];

    /// What a run uses that chooses none: more steps on faster kinds of adapter.
    pub fn for_adapter(adapter: &AdapterSummary) -> Self {
        match adapter.kind.as_str() {
            "discrete" => Self::Best,
            "integrated" | "virtual" => Self::Quality,
            _ => Self::Balanced,
        }
    }

    /// Sets the values in which the preset differs from the defaults.
    pub fn apply(self, config: &mut Config) {
        let mapping = &mut config.mapping;
        match self {
            Self::Realtime => {
                config.replay.real_time = true;
                mapping.yields_to_keyframes = true;
                mapping.first_iterations = 10;
                mapping.window.recent = 4;
                mapping.window.covisible = 2;
                // Where few steps fit between two keyframes, the six or so that density control costs are many: it runs at every fifth keyframe,
                // on fast adapters sooner, and before the steps, so that no keyframe waits for it.
                mapping.density.every = 5;
                mapping.density.after_share = 0.0;
            }
            Self::Draft => {
                // With so few steps a keyframe's own are best kept for the end.
                (mapping.first_iterations, mapping.iterations_per_keyframe) = (5, 2);
                mapping.refine.steps_per_keyframe = 0;
                mapping.refine.final_epochs = 5;
                // A short refinement has no time to settle, or to learn what exposures leave to it.
                (mapping.exposure.measured_every, mapping.exposure.pull) = (10, 0.4);
                (mapping.refine.final_lr_scale_position, mapping.refine.final_lr_scale) = (0.3, 0.4);
            }
            Self::Balanced => {}
            Self::Quality => refined(config, 20, 48),
            Self::Best => refined(config, 30, 135),
        }
    }
}

/// Denser insertion and growth, less pruning, and more steps over all keyframes: so many after each keyframe, and epochs at the end.
fn refined(config: &mut Config, steps_per_keyframe: usize, final_epochs: usize) {
    let mapping = &mut config.mapping;
    (mapping.refine.steps_per_keyframe, mapping.refine.final_epochs) = (steps_per_keyframe, final_epochs);
    mapping.insertion.detail = 0.04;
    let rules = &mut mapping.density.multi_view;
    (rules.min_contribution, rules.pixel_gradient) = (0.5, 0.6);
}

/// Shares of the recorded resolution that real time may choose.
const SCALES: [f64; 6] = [1.0, 0.75, 0.5, 0.375, 0.25, 0.125];
/// Longest training step on an otherwise idle machine. Beside the tracker and with a grown map it takes three times as long, and about five
/// of those still fit between two keyframes of a walking camera.
const LONGEST_STEP: Duration = Duration::from_millis(15);
/// Pixels for each Gaussian in view, as insertion leaves them.
const PIXELS_PER_GAUSSIAN: u32 = 8;
/// Least side of the mapped image, pixels.
const LEAST_PIXELS: u32 = 96;

/// Most pixels of the mapped image, by kind of adapter.
const PIXELS_ON_CPU: u32 = 150_000;
const PIXELS_ON_INTEGRATED: u32 = 600_000;

/// The shares of a recorded size that leave [`LEAST_PIXELS`] on each side, the largest first; 1 always.
fn usable_scales((width, height): (u32, u32)) -> impl Iterator<Item = f64> + Clone {
    let usable = move |scale: &f64| *scale == 1.0 || (f64::from(width.min(height)) * scale).round() >= f64::from(LEAST_PIXELS);
    SCALES.into_iter().take_while(usable)
}

/// Share of the recorded resolution that is mapped where nothing chooses one: within a number of pixels by kind of adapter. A discrete GPU
/// maps at the recorded resolution.
pub fn default_scale(adapter: &AdapterSummary, recording: &Recording) -> f64 {
    let pinhole = &recording.sequence().camera.pinhole;
    scale_within(most_pixels(&adapter.kind), (pinhole.width, pinhole.height))
}

fn most_pixels(adapter_kind: &str) -> u32 {
    match adapter_kind {
        "discrete" => u32::MAX,
        "integrated" | "virtual" => PIXELS_ON_INTEGRATED,
        _ => PIXELS_ON_CPU,
    }
}

/// The largest usable scale with at most so many pixels, or the smallest usable one.
fn scale_within(most_pixels: u32, recorded: (u32, u32)) -> f64 {
    let pixels = |scale: f64| [recorded.0, recorded.1].map(|side| (f64::from(side) * scale).round()).iter().product::<f64>();
    let scales = usable_scales(recorded);
    scales.clone().find(|scale| pixels(*scale) <= f64::from(most_pixels)).or(scales.last()).unwrap_or(1.0)
}

/// Measures the largest share of the recorded resolution at which a training step is fast enough for real time.
///
/// # Errors
/// If the adapter fails.
pub fn realtime_scale(gpu: &Arc<Gpu>, recording: &Recording) -> Result<f64, GpuError> {
    let mut chosen = 1.0;
    let recorded = recording.sequence().camera.pinhole;
    for scale in usable_scales((recorded.width, recorded.height)) {
        let pinhole = recorded.scaled(scale);
        chosen = scale;
        let size = (pinhole.width, pinhole.height);
        let gaussians = (size.0 * size.1 / PIXELS_PER_GAUSSIAN) as usize;
        let scene = BenchScene::new(gpu, gaussians, size, recording.config().mapping.sh_degree)?;
        let wall = StepRunner::new(gpu, scene, BlendForm::of(gpu))?.run()?.wall;
        tracing::info!(scale, step_ms = wall.as_secs_f64() * 1e3, "training step measured");
        if wall <= LONGEST_STEP {
            break;
        }
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resolution_and_preset_follow_from_the_kind_of_adapter() {
        let on = |kind: &str, recorded: (u32, u32)| scale_within(most_pixels(kind), recorded);
        assert_eq!([(160, 120), (640, 480), (1920, 1080)].map(|size| on("cpu", size)), [1.0, 0.5, 0.25]);
        assert_eq!(on("cpu", (4000, 150)), 0.75, "half the size would have too few rows");
        assert_eq!((on("integrated", (640, 480)), on("integrated", (1920, 1080))), (1.0, 0.5));
        assert_eq!(on("discrete", (3840, 2160)), 1.0);
        let preset = |kind: &str| {
            let text = String::new;
            Preset::for_adapter(&AdapterSummary { name: text(), backend: text(), kind: kind.into(), driver: text() })
        };
        assert_eq!(["discrete", "integrated", "cpu"].map(preset), [Preset::Best, Preset::Quality, Preset::Balanced]);
    }

    #[test]
    fn presets_are_valid_and_differ() {
        let of = |preset: Preset| {
            let mut config = Config::default();
            preset.apply(&mut config);
            config.validate().unwrap();
            config
        };
        assert_eq!(of(Preset::Balanced), Config::default());
        let epochs =
            [Preset::Draft, Preset::Balanced, Preset::Quality, Preset::Best].map(|preset| of(preset).mapping.refine.final_epochs);
        assert!(epochs.is_sorted_by(|fewer, more| fewer < more), "{epochs:?}");
        let live = Preset::ALL.map(|preset| (of(preset).replay.real_time, of(preset).mapping.yields_to_keyframes));
        assert_eq!(live, [(true, true), (false, false), (false, false), (false, false), (false, false)]);
    }
}
