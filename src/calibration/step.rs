//! The training step, stage by stage, beside each stage's floor.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::rates::Rates;
use super::scene::BenchScene;
use super::work::{Work, count_work};
use crate::gpu::{Gpu, GpuError};
use crate::optimise::{AdamConfig, LossConfig, Trainer, TrainingView};
use crate::render::BlendForm;
use crate::splat::ShDegree;

/// What to measure.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct StepBench {
    /// Gaussians in the map.
    pub gaussians: usize,
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Degree of the spherical harmonics.
    pub sh_degree: ShDegree,
    /// Form of the blending passes.
    pub form: BlendForm,
    /// Timed steps; a few untimed ones precede them.
    pub steps: usize,
}

/// One stage: what it took, and what the adapter would need at its best for the bytes and operations that it must move and do.
#[derive(Clone, Debug, Serialize)]
pub struct StageReport {
    /// Name of the stage.
    pub stage: String,
    /// Median over batches of steps; absent where the adapter gives no timestamps.
    pub ms: f64,
    /// Compulsory bytes over the bandwidth, or operations over the arithmetic rate, whichever is longer; 0 where nothing is compulsory.
    pub floor_ms: f64,
}

/// The measured step.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// The measured configuration.
    pub bench: StepBench,
    /// Work of one step.
    pub work: Work,
    /// Wall time per step, submitted in batches: median.
    pub step_ms: f64,
    /// Sum of the stages' floors, milliseconds.
    pub floor_ms: f64,
    /// The host's time to encode and submit a step, while the GPU works on others.
    pub encode_ms: f64,
    /// Forward evaluations per second of the forward blending.
    pub evaluations_per_s: Option<f64>,
    /// The stages, by name.
    pub stages: Vec<StageReport>,
}

/// Least steps, and least time, before the timed ones: a GPU at rest runs at a fraction of its clock.
const WARM_UP: (usize, Duration) = (3, Duration::from_millis(300));
/// Steps submitted at once while the stages are timed.
const BATCH: usize = 4;
/// Steps submitted at once for the wall time, as the mapper does: on a GPU the wait after them is a good part of four steps.
const GPU_BATCH: usize = 12;

/// Repeats one training step on a scene that it leaves as it is.
#[derive(Debug)]
pub struct StepRunner {
    gpu: Arc<Gpu>,
    scene: BenchScene,
    trainer: Trainer,
    still: AdamConfig,
    /// Steps submitted at once for the wall time.
    batch: usize,
    /// The work in one step.
    pub work: Work,
}

/// What a few steps took.
#[derive(Clone, Debug, Default)]
pub struct StepTimes {
    /// Wall time per step.
    pub wall: Duration,
    /// The host's share of it.
    pub encoding: Duration,
    /// Time on the GPU per step, by stage; empty where the adapter gives no timestamps.
    pub stages: BTreeMap<&'static str, Duration>,
}

impl StepRunner {
    /// `gpu` should be opened with [`Gpu::open_profiled`]. Compiles and warms up.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Arc<Gpu>, scene: BenchScene, form: BlendForm) -> Result<Self, GpuError> {
        let mut trainer = Trainer::with_blending(gpu.clone(), form)?;
        let work = count_work(&mut trainer, &scene.cloud, &scene.camera)?;
        // Rates of zero keep the scene as it is, step after step, at the same cost.
        let still = AdamConfig::default().scaled(0.0, 0.0);
        let batch = if gpu.is_software() { BATCH } else { GPU_BATCH };
        let mut runner = Self { gpu: gpu.clone(), scene, trainer, still, batch, work };
        let (least_steps, least_time) = WARM_UP;
        let started = Instant::now();
        let mut steps = 0;
        while steps < least_steps || started.elapsed() < least_time {
            runner.steps(1)?;
            steps += 1;
        }
        gpu.take_profile()?;
        Ok(runner)
    }

    fn steps(&mut self, count: usize) -> Result<(), GpuError> {
        let views = [TrainingView::new(self.scene.camera, &self.scene.target); GPU_BATCH];
        self.trainer.steps(&self.scene.cloud, &views[..count], &LossConfig::default(), &self.still)?;
        Ok(())
    }

    /// Runs a batch of steps and waits for them, then times the stages of another.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn run(&mut self) -> Result<StepTimes, GpuError> {
        self.gpu.pause_profile(true);
        let encoded = self.trainer.encode_time();
        let started = Instant::now();
        let timed = self.steps(self.batch);
        let wall = started.elapsed() / self.batch as u32;
        let encoding = (self.trainer.encode_time() - encoded) / self.batch as u32;
        self.gpu.pause_profile(false);
        timed?;
        if self.gpu.has_profile() {
            self.steps(BATCH)?;
        }
        let mut stages = BTreeMap::<_, Duration>::new();
        for (label, ms) in self.gpu.take_profile()?.unwrap_or_default() {
            *stages.entry(label).or_default() += Duration::from_secs_f64(ms * 1e-3 / BATCH as f64);
        }
        stages.remove(Trainer::END_MARK);
        Ok(StepTimes { wall, encoding, stages })
    }
}

/// Measures a training step on a scene.
///
/// # Errors
/// [`GpuError`] if a buffer does not fit or the device fails.
pub fn bench_step(gpu: &Arc<Gpu>, scene: BenchScene, bench: &StepBench, rates: &Rates) -> Result<StepReport, GpuError> {
    let mut runner = StepRunner::new(gpu, scene, bench.form)?;
    let times = (0..bench.steps.div_ceil(runner.batch)).map(|_| runner.run()).collect::<Result<Vec<_>, _>>()?;
    let ms = |part: &dyn Fn(&StepTimes) -> Duration| {
        let mut all: Vec<f64> = times.iter().map(|t| part(t).as_secs_f64() * 1e3).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or_default()
    };
    let work = runner.work;
    let floors = floors(&work, bench, rates);
    let stages: Vec<StageReport> = times
        .iter()
        .flat_map(|t| t.stages.keys())
        .collect::<BTreeSet<_>>()
        .into_iter()
        .map(|&stage| StageReport {
            stage: stage.into(),
            ms: ms(&|t| t.stages.get(stage).copied().unwrap_or_default()),
            floor_ms: floors.get(stage).copied().unwrap_or(0.0),
        })
        .collect();
    let forward = stages.iter().find(|s| s.stage == bench.form.forward_stage());
    Ok(StepReport {
        bench: *bench,
        work,
        step_ms: ms(&|t| t.wall),
        floor_ms: floors.values().sum(),
        encode_ms: ms(&|t| t.encoding),
        evaluations_per_s: forward.map(|s| work.evaluations as f64 / (s.ms * 1e-3)),
        stages,
    })
}

/// Milliseconds that each stage needs at the adapter's own rates. Bytes are counted once in and once out of memory, operations as in
/// the shaders (an exponential as 8, a division as 4).
fn floors(work: &Work, bench: &StepBench, rates: &Rates) -> BTreeMap<&'static str, f64> {
    let coefficients = bench.sh_degree.coefficients() as f64;
    let [n, visible, intersections, pixels] = [work.gaussians, work.visible, work.intersections, work.pixels].map(|v| v as f64);
    let (evaluations, blended, back) = (work.evaluations as f64, work.blended as f64, work.backward_evaluations as f64);
    let floor = |bytes: f64, flops: f64| 1e3 * (bytes / rates.bytes_per_s).max(flops / rates.flops_per_s);
    let (depth_passes, tile_passes) = (2.0, if work.tiles < 256 { 1.0 } else { 2.0 });
    let planes = 3.0 + coefficients;
    // Separable 11-tap filters for a quarter of the windows: half of the columns in half of the rows, then half of these rows; five quantities
    // forward, three backward, on three channels.
    let taps = 2.0 * (0.5 + 0.25) * 11.0 * 3.0 * pixels;
    let sorts = match bench.form {
        BlendForm::Wide => vec![("sort_tiles", floor(intersections * 28.0, 0.0))],
        BlendForm::Narrow => vec![
            ("sort_count_digits", floor(4.0 * (depth_passes * visible + tile_passes * intersections), 0.0)),
            ("sort_scatter", floor(16.0 * (depth_passes * visible + tile_passes * intersections), 0.0)),
            ("tile_ranges", floor(intersections * 4.0, 0.0)),
        ],
    };
    let stages = [
        ("project_forward", floor(n * (16.0 * (2.0 + coefficients) + 20.0) + visible * 64.0, n * 150.0)),
        (bench.form.lists_stage(), floor(visible * 2.0 * 40.0 + intersections * 12.0, 2.0 * intersections * 40.0)),
        (bench.form.forward_stage(), floor(intersections * 56.0 + pixels * 24.0, evaluations * 11.0 + blended * 24.0)),
        ("loss_forward", floor(pixels * (20.0 + 12.0 + 12.0), taps * 5.0)),
        ("loss_backward", floor(pixels * (20.0 + 12.0 + 12.0 + 32.0), taps * 3.0)),
        (bench.form.backward_stage(), floor(intersections * 104.0 + pixels * 56.0, back * 11.0 + blended * 70.0)),
        ("project_backward_adam", floor(intersections * 48.0 + visible * planes * 16.0 * 6.0, visible * (400.0 + planes * 60.0))),
    ];
    stages.into_iter().chain(sorts).collect()
}
