//! One training step on the GPU: forward, loss, backward, Adam; and the same without stepping, for whoever wants the gradients.

mod encode;
mod gradients;
mod state;

use std::sync::Arc;
use std::time::{Duration, Instant};

pub use gradients::{Gradients, ImageGradients};
pub use state::TrainerState;

use super::image_buffers::{self, ImageBuffers};
use super::kernels::Kernels;
use super::scores::{ErrorPixels, GaussianScore, OverScores, ScoredImage, Scores};
use super::survey::SurveyPass;
use super::{AdamConfig, LossConfig, LossTerms, Pixels, PlanarConfig, TargetImage};
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::render::layout::{StepLog, View};
use crate::render::{BlendForm, Blending, GpuCloud, Rasterizer, Rendered, ViewCounts};
use crate::splat::model::Dropout;
use crate::splat::{Exposure, ViewCamera};

/// What a step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Terms of the image loss.
    pub loss: LossTerms,
    /// Work of the view.
    pub counts: ViewCounts,
}

/// A view to learn from.
#[derive(Clone, Copy, Debug)]
pub struct TrainingView<'a> {
    /// Pose and intrinsics.
    pub camera: ViewCamera,
    /// Recorded image and depth.
    pub target: &'a TargetImage,
    /// Pixels of an offloaded target.
    pub streamed: Option<&'a Pixels>,
    /// Whether the step also scores the Gaussians (see [`Trainer::begin_scores`]).
    pub scored: Option<ErrorPixels>,
    /// Factor on the weight of the target's depth in the loss: 1 if a sensor measured it.
    pub depth_confidence: f32,
    /// Exposure of the target against the map's.
    pub exposure: Exposure,
    /// Gaussians that the step leaves out.
    pub dropout: Dropout,
    /// Factor on the weights of a planar surface, 0 to 1.
    pub surface_share: f32,
}

impl<'a> TrainingView<'a> {
    /// The whole view at full learning rates and in the map's exposure, not scored.
    pub fn new(camera: ViewCamera, target: &'a TargetImage) -> Self {
        let (exposure, dropout) = Default::default();
        Self { camera, target, streamed: None, scored: None, depth_confidence: 1.0, exposure, dropout, surface_share: 1.0 }
    }
}

/// Where the backward pass starts from.
enum Objective<'a> {
    /// The loss of a view against its target, and which of the logs receives it.
    Image { view: TrainingView<'a>, loss: &'a LossConfig, log: usize },
    /// Gradients by the image are in the buffer already.
    Given,
}

/// What the backward pass ends in.
enum Sink<'a> {
    Adam(&'a AdamConfig),
    Gradient(&'a GpuBuffer),
}

/// The training step: the rasterizer, the passes that follow it, and all their scratch buffers.
#[derive(Debug)]
pub struct Trainer {
    pub(super) rasterizer: Rasterizer,
    kernels: Kernels,
    /// Of a planar surface.
    planar: PlanarConfig,
    scores: Scores,
    pub(super) survey: SurveyPass,
    /// Steps submitted so far, and the host's time to encode and submit them.
    steps: usize,
    encode_time: Duration,
    /// Of each size of view, the present one first.
    images: Vec<ImageBuffers>,
    /// Logs of the steps of a submission, and windows on each.
    log: GpuBuffer,
    logs: Vec<GpuBuffer>,
}

/// Most steps of a submission: their uniforms fit, five a step at most.
const STEPS_AT_ONCE: usize = 16;
/// Bytes between two logs: the least alignment of their bindings that every adapter has.
const LOG_STRIDE: usize = 256;

impl Trainer {
    /// The mark that ends a step's last stage in the profile.
    pub const END_MARK: &'static str = "end";

    /// A trainer with the form of the blending passes that suits the adapter.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        let form = BlendForm::of(&gpu);
        Self::with_blending(gpu, form)
    }

    /// A trainer with the given blending passes.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn with_blending(gpu: Arc<Gpu>, blending: impl Into<Blending>) -> Result<Self, GpuError> {
        let rasterizer = Rasterizer::with_blending(gpu, blending)?;
        let gpu = rasterizer.gpu();
        let kernels = Kernels::new(&rasterizer);
        gpu.check()?;
        let log = GpuBuffer::computed_uniform(gpu, "step logs", (STEPS_AT_ONCE * LOG_STRIDE) as u64)?;
        let logs = (0..STEPS_AT_ONCE).map(|i| log.window((i * LOG_STRIDE) as u64, LOG_STRIDE as u64)).collect();
        Ok(Self {
            kernels,
            planar: PlanarConfig::default(),
            scores: Scores::new(&rasterizer)?,
            survey: SurveyPass::new(gpu)?,
            steps: 0,
            encode_time: Duration::ZERO,
            images: Vec::new(),
            log,
            logs,
            rasterizer,
        })
    }

    /// With these weights of a planar surface.
    pub fn with_planar(self, planar: PlanarConfig) -> Self {
        Self { planar, ..self }
    }

    /// For each view in turn: renders the map, compares it with the target, and moves the Gaussians that were blended by one step of
    /// Adam. The steps are submitted together, without waiting in between; what they report is read at the end. A step whose intersections
    /// did not fit moved nothing and is repeated after the others, with larger buffers.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn steps(
        &mut self,
        cloud: &GpuCloud,
        views: &[TrainingView<'_>],
        loss: &LossConfig,
        adam: &AdamConfig,
    ) -> Result<Vec<StepReport>, GpuError> {
        Ok(self.steps_and_then(cloud, views, (loss, adam), None)?.0)
    }

    /// The same, with a pass over the scores since [`Self::begin_scores`] behind the last step, and what is to be read of it in the same wait.
    /// Where steps are repeated, so is the pass: it must not add to what it did before.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn steps_and_then(
        &mut self,
        cloud: &GpuCloud,
        views: &[TrainingView<'_>],
        rules: (&LossConfig, &AdamConfig),
        then: Option<&dyn OverScores>,
    ) -> Result<(Vec<StepReport>, Vec<u32>), GpuError> {
        let mut reports = vec![StepReport::default(); views.len()];
        let mut words = Vec::new();
        let mut pending: Vec<usize> = (0..views.len()).collect();
        while !pending.is_empty() {
            let mut repeat = Vec::new();
            for chunk in pending.chunks(STEPS_AT_ONCE) {
                let chosen: Vec<&TrainingView<'_>> = chunk.iter().map(|&i| &views[i]).collect();
                let (logs, read) = self.steps_at_once(cloud, &chosen, rules, then)?;
                words = read;
                for (&i, log) in chunk.iter().zip(&logs) {
                    let pixels = views[i].target.width * views[i].target.height;
                    match self.rasterizer.counts(&log.counters) {
                        Some(counts) => reports[i] = StepReport { loss: LossTerms::from_sums(log.loss, pixels), counts },
                        None => repeat.push(i),
                    }
                    self.rasterizer.reserve_for(&log.counters)?;
                }
            }
            pending = repeat;
        }
        Ok((reports, words))
    }

    /// Takes up to [`STEPS_AT_ONCE`] steps and reads their logs. They are one submission where their views have one size, and none of them but
    /// the first streams its target.
    fn steps_at_once(
        &mut self,
        cloud: &GpuCloud,
        views: &[&TrainingView<'_>],
        (loss, adam): (&LossConfig, &AdamConfig),
        then: Option<&dyn OverScores>,
    ) -> Result<(Vec<StepLog>, Vec<u32>), GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let size = |view: &TrainingView<'_>| (view.target.width, view.target.height);
        let mut unsubmitted = None;
        let mut taken = 0;
        for together in views.chunk_by(|before, view| view.streamed.is_none() && size(before) == size(view)) {
            unsubmitted.take().into_iter().for_each(|encoder| gpu.submit(encoder));
            let started = Instant::now();
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.rasterizer.uniforms.begin();
            for view in together {
                let viewpoint = Viewpoint { camera: &view.camera, background: [0.0; 3] };
                let objective = Objective::Image { view: **view, loss, log: taken };
                self.encode(&mut pass, cloud, &viewpoint, &objective, &Sink::Adam(adam))?;
                self.steps += 1;
                taken += 1;
            }
            if let Some(then) = then.filter(|_| taken == views.len()) {
                then.encode(&mut pass, self.scores.buffer());
            }
            drop(pass);
            self.rasterizer.uniforms.upload(&gpu);
            unsubmitted = Some(encoder);
            self.encode_time += started.elapsed();
        }
        let words = LOG_STRIDE / std::mem::size_of::<u32>();
        let logs = self.log.part::<u32>(0, taken * words);
        let read = gpu.read(unsubmitted, &std::iter::once(logs).chain(then.map(OverScores::part)).collect::<Vec<_>>())?;
        let entry = |log: &[u32]| bytemuck::pod_read_unaligned(&bytemuck::cast_slice(log)[..std::mem::size_of::<StepLog>()]);
        let logs = read.part::<u32>(0).chunks_exact(words).map(entry).collect();
        Ok((logs, then.map_or_else(Vec::new, |_| read.part(1))))
    }

    /// A pass over the scores by itself, and what is to be read of it.
    ///
    /// # Errors
    /// [`GpuError`] if the device fails.
    pub fn over_scores(&self, then: &dyn OverScores) -> Result<Vec<u32>, GpuError> {
        let gpu = self.rasterizer.gpu();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        then.encode(&mut encoder.begin_compute_pass(&Default::default()), self.scores.buffer());
        Ok(gpu.read(Some(encoder), &[then.part()])?.part(0))
    }

    /// `[2, capacity]` vec4 as `shaders/gather_scores.wgsl` has them, for passes that need nothing read.
    pub fn scores(&self) -> &GpuBuffer {
        self.scores.buffer()
    }

    /// Renders a view over `background` and reads it back.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, cloud: &GpuCloud, camera: &ViewCamera, background: [f32; 3]) -> Result<Rendered, GpuError> {
        self.rasterizer.render(cloud, camera, background)
    }

    /// Bytes by which scratch buffers grow for a view that has a few more intersections than they have room for.
    pub fn growth_bytes(&self) -> u64 {
        self.rasterizer.growth_bytes()
    }

    /// The form of the blending passes.
    pub fn form(&self) -> BlendForm {
        self.rasterizer.form()
    }

    pub(crate) fn rasterizer_mut(&mut self) -> &mut Rasterizer {
        &mut self.rasterizer
    }

    /// Forgets all scores: from here on, steps of scored views add to those of `cloud`, which must not grow or shrink meanwhile.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn begin_scores(&mut self, cloud: &GpuCloud) -> Result<(), GpuError> {
        self.scores.clear(self.rasterizer.gpu(), cloud)
    }

    /// The scores since [`Self::begin_scores`], `[N]` in map order.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn read_scores(&self, cloud: &GpuCloud) -> Result<Vec<GaussianScore>, GpuError> {
        self.scores.read(self.rasterizer.gpu(), cloud)
    }

    /// The host's time to encode and submit all steps so far.
    pub fn encode_time(&self) -> Duration {
        self.encode_time
    }

    /// Puts the buffers for a size of view in front.
    fn choose_images(&mut self, size: (u32, u32)) -> Result<(), GpuError> {
        let planes = 1 + self.rasterizer.blending().image_planes();
        image_buffers::choose(&mut self.images, self.rasterizer.gpu(), size, planes)
    }

    /// Encodes one whole step.
    fn encode(
        &mut self,
        pass: &mut wgpu::ComputePass<'_>,
        cloud: &GpuCloud,
        viewpoint: &Viewpoint<'_>,
        objective: &Objective<'_>,
        sink: &Sink<'_>,
    ) -> Result<(), GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let dropout = match objective {
            Objective::Image { view, .. } => view.dropout,
            Objective::Given => Dropout::default(),
        };
        let view = View::new(viewpoint.camera, viewpoint.background).with_dropout(dropout);
        let prepared = self.rasterizer.prepare_view(cloud, view)?;
        self.choose_images((prepared.view.width, prepared.view.height))?;
        match objective {
            Objective::Image { view, loss, log } => {
                if let (None, Some(pixels)) = (&view.target.pixels, view.streamed) {
                    self.images[0].stream(&gpu, pixels)?;
                }
                let cells = self.put_uniforms(view, loss, &prepared);
                self.rasterizer.encode_forward(pass, cloud.parameters(), &prepared);
                let target = self.images[0].pixels(view.target);
                self.encode_loss(pass, &prepared, target, &cells, &self.logs[*log]);
                if let Some(setup) = cells.scores {
                    let image = ScoredImage { gradients: &self.images[0].gradients, log: &self.logs[*log] };
                    self.scores.encode(pass, &self.rasterizer, &prepared, &image, setup);
                }
                self.encode_backward(pass, cloud, &prepared, sink);
            }
            Objective::Given => {
                self.rasterizer.encode_forward(pass, cloud.parameters(), &prepared);
                self.encode_backward(pass, cloud, &prepared, sink);
            }
        }
        gpu.mark(pass, Self::END_MARK);
        Ok(())
    }
}

/// A camera and the colour behind the map, linear RGB.
struct Viewpoint<'a> {
    camera: &'a ViewCamera,
    background: [f32; 3],
}
