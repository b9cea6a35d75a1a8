//! The training step, stage by stage, beside each stage's floor.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::rates::Rates;
use super::scene::BenchScene;
use super::work::{Work, count_work};
use crate::gpu::{Gpu, GpuError};
use crate::optimise::{AdamConfig, LossConfig, Optimiser, TrainingView};
use crate::render::{BlendForm, Rasterizer};
use crate::splat::ShDegree;

/// What to measure.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct StepBench {
    pub gaussians: usize,
    pub width: u32,
    pub height: u32,
    pub sh_degree: ShDegree,
    /// Form of the blending passes.
    pub form: BlendForm,
    /// Timed steps; a few untimed ones precede them.
    pub steps: usize,
}

/// One stage: what it took, and what the adapter would need at its best for the bytes and operations that it must move and do.
#[derive(Clone, Debug, Serialize)]
pub struct StageReport {
    pub stage: String,
    /// Mean over the timed steps; absent where the adapter gives no timestamps.
    pub ms: f64,
    /// Compulsory bytes over the bandwidth, or operations over the arithmetic rate, whichever is longer; 0 where nothing is compulsory.
    pub floor_ms: f64,
}

/// The measured step.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    pub bench: StepBench,
    pub work: Work,
    /// Wall time per step, submitted in batches: median.
    pub step_ms: f64,
    pub floor_ms: f64,
    /// The host's time to encode and submit a step, while the GPU works on others.
    pub encode_ms: f64,
    /// Forward evaluations per second of `rasterize_forward`.
    pub evaluations_per_s: Option<f64>,
    pub stages: Vec<StageReport>,
}

const WARM_UP: usize = 3;
const BATCH: usize = 4;

/// Measures a training step on a made-up scene.
pub fn bench_step(gpu: &Arc<Gpu>, bench: &StepBench, rates: &Rates) -> Result<StepReport, GpuError> {
    let scene = BenchScene::new(gpu, bench.gaussians, (bench.width, bench.height), bench.sh_degree)?;
    let mut rasterizer = Rasterizer::with_form(gpu.clone(), bench.form)?;
    let mut optimiser = Optimiser::new(&rasterizer)?;
    let work = count_work(&mut rasterizer, &scene.cloud, &scene.camera)?;
    // Rates of zero keep the scene as it is, step after step, at the same cost.
    let still = AdamConfig {
        position_rate: 0.0,
        opacity_rate: 0.0,
        scale_rate: 0.0,
        rotation_rate: 0.0,
        color_rate: 0.0,
        harmonics_rate: 0.0,
        ..AdamConfig::default()
    };
    let views = [TrainingView { camera: scene.camera, target: &scene.target }; BATCH];
    let configs = (&LossConfig::default(), &still);
    for _ in 0..WARM_UP {
        optimiser.steps(&mut rasterizer, &scene.cloud, &views[..1], configs)?;
    }
    gpu.take_profile()?;
    let encoded_before = optimiser.encode_time();
    let mut walls = Vec::new();
    let mut times: BTreeMap<&str, f64> = BTreeMap::new();
    let mut steps = 0;
    while steps < bench.steps {
        let started = Instant::now();
        optimiser.steps(&mut rasterizer, &scene.cloud, &views, configs)?;
        walls.push(started.elapsed().as_secs_f64() * 1e3 / BATCH as f64);
        for (label, ms) in gpu.take_profile()?.unwrap_or_default() {
            *times.entry(label).or_default() += ms;
        }
        steps += BATCH;
    }
    walls.sort_by(f64::total_cmp);
    let floors = floors(&work, bench, rates);
    let stages: Vec<StageReport> = times
        .iter()
        .filter(|(label, _)| **label != "end")
        .map(|(label, ms)| StageReport {
            stage: (*label).into(),
            ms: ms / steps as f64,
            floor_ms: floors.get(label).copied().unwrap_or(0.0),
        })
        .collect();
    let forward = stages.iter().find(|s| s.stage == "rasterize_forward");
    Ok(StepReport {
        bench: *bench,
        work,
        step_ms: walls[walls.len() / 2],
        floor_ms: floors.values().sum(),
        encode_ms: (optimiser.encode_time() - encoded_before).as_secs_f64() * 1e3 / steps as f64,
        evaluations_per_s: forward.map(|s| work.evaluations as f64 / (s.ms * 1e-3)),
        stages,
    })
}

/// Milliseconds that each stage needs at the adapter's own rates. Bytes are counted once in and once out of memory, operations as in
/// the shaders (an exponential as 8, a division as 4).
fn floors(work: &Work, bench: &StepBench, rates: &Rates) -> BTreeMap<&'static str, f64> {
    let coefficients = bench.sh_degree.coefficients() as f64;
    let [n, visible, pairs, pixels] = [work.gaussians, work.visible, work.pairs, work.pixels].map(|v| v as f64);
    let (evaluations, blended, back) = (work.evaluations as f64, work.blended as f64, work.backward_evaluations as f64);
    let floor = |bytes: f64, flops: f64| 1e3 * (bytes / rates.bytes_per_s).max(flops / rates.flops_per_s);
    let (depth_passes, tile_passes) = (4.0, if work.tiles < 256 { 1.0 } else { 2.0 });
    let planes = 3.0 + coefficients;
    // Separable 11-tap filters over rows and columns: five quantities forward, three backward, on three channels.
    let taps = 2.0 * 2.0 * 11.0 * 3.0 * pixels;
    BTreeMap::from([
        ("project_forward", floor(n * (16.0 * (2.0 + coefficients) + 20.0) + visible * 64.0, n * 150.0)),
        ("sort_count_digits", floor(4.0 * (depth_passes * visible + tile_passes * pairs), 0.0)),
        ("sort_scatter", floor(16.0 * (depth_passes * visible + tile_passes * pairs), 0.0)),
        ("tile_lists", floor(visible * 2.0 * 40.0 + pairs * 12.0, 2.0 * pairs * 40.0)),
        ("tile_ranges", floor(pairs * 4.0, 0.0)),
        ("rasterize_forward", floor(pairs * 56.0 + pixels * 24.0, evaluations * 11.0 + blended * 24.0)),
        ("loss_forward", floor(pixels * (20.0 + 48.0 + 12.0), taps * 5.0)),
        ("loss_backward", floor(pixels * (20.0 + 48.0 + 12.0 + 32.0), taps * 3.0)),
        ("rasterize_backward", floor(pairs * 104.0 + pixels * 56.0, back * 11.0 + blended * 70.0)),
        ("project_backward_adam", floor(pairs * 48.0 + visible * planes * 16.0 * 6.0, visible * (400.0 + planes * 60.0))),
    ])
}
