//! One training step on the GPU: forward, loss, backward, Adam; and the same without stepping, for whoever wants the gradients.

mod encode;
mod state;

use std::sync::Arc;
use std::time::{Duration, Instant};

pub use state::TrainerState;

use bytemuck::{Pod, Zeroable};

use super::image_buffers::{self, ImageBuffers};
use super::kernels::Kernels;
use super::scores::{ErrorPixels, GaussianScore, ScoredImage, Scores};
use super::tile_sampling::{TileSampler, TileSampling};
use super::{AdamConfig, LossConfig, LossTerms, Pixels, TargetImage};
use crate::geometry::Pinhole;
use crate::gpu::{Gpu, GpuBuffer, GpuError};
use crate::render::layout::{AdamSetup, COUNTERS, Counter, LossSetup};
use crate::render::{BlendForm, GpuCloud, Rasterizer, Rendered, ViewCounts, cloud_from_planes};
use crate::splat::{Exposure, GaussianCloud, ViewCamera};

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
    /// Factor on all learning rates of the step.
    pub lr_scale: f32,
    /// Factor on the weight of the target's depth in the loss: 1 if a sensor measured it.
    pub depth_confidence: f32,
    /// Exposure of the target against the map's.
    pub exposure: Exposure,
    /// Tiles that the step samples; `None`: all. A scored step uses all.
    pub tile_sampling: Option<TileSampling>,
}

impl<'a> TrainingView<'a> {
    /// The whole view at full learning rates and in the map's exposure, not scored.
    pub fn new(camera: ViewCamera, target: &'a TargetImage) -> Self {
        let exposure = Exposure::default();
        Self { camera, target, streamed: None, scored: None, lr_scale: 1.0, depth_confidence: 1.0, exposure, tile_sampling: None }
    }
}

/// What a step leaves behind on the GPU: sums of the loss, and the counters.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct StepLog {
    loss: [f32; 4],
    counters: [Counter; COUNTERS as usize],
}

/// Gradient of a loss by the map.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// Terms of the image loss.
    pub loss: LossTerms,
    /// By the raw parameters of each Gaussian, in the shape of the map.
    pub cloud: GaussianCloud,
}

/// Gradient of a loss by a rendered image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImageGradients {
    /// `[H, W]` by colour (r, g, b) and by Σ w z, 1/metres.
    pub color_depth: Vec<[f32; 4]>,
    /// `[H, W]` by alpha.
    pub alpha: Vec<f32>,
}

/// Where the backward pass starts from.
enum Objective<'a> {
    /// The loss of a view against its target.
    Image { view: TrainingView<'a>, loss: &'a LossConfig },
    /// Gradients by the image are in the buffer already.
    Given,
}

/// What the backward pass ends in.
enum Sink<'a> {
    Adam,
    Gradient(&'a GpuBuffer),
}

/// The training step: the rasterizer, the passes that follow it, and all their scratch buffers.
#[derive(Debug)]
pub struct Trainer {
    rasterizer: Rasterizer,
    kernels: Kernels,
    scores: Scores,
    sampler: TileSampler,
    /// Steps submitted so far, and the host's time to encode and submit them.
    steps: usize,
    encode_time: Duration,
    adam: GpuBuffer,
    loss_setup: GpuBuffer,
    /// Of each size of view, the present one first.
    images: Vec<ImageBuffers>,
    loss_total: GpuBuffer,
}

impl Trainer {
    /// The mark that ends a step's last stage in the profile.
    pub const END_MARK: &'static str = "end";

    /// A trainer with the form of the blending passes that suits the adapter.
    ///
    /// # Errors
    /// [`GpuError`] if a shader does not compile or a buffer does not fit.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        let form = BlendForm::of(&gpu);
        Self::with_form(gpu, form)
    }

    /// A trainer with the given form of the blending passes.
    ///
    /// # Errors
    /// [`GpuError`] if a shader does not compile or a buffer does not fit.
    pub fn with_form(gpu: Arc<Gpu>, form: BlendForm) -> Result<Self, GpuError> {
        let rasterizer = Rasterizer::with_form(gpu, form)?;
        let gpu = rasterizer.gpu();
        let kernels = Kernels::new(&rasterizer);
        gpu.check()?;
        Ok(Self {
            kernels,
            scores: Scores::new(&rasterizer)?,
            sampler: TileSampler::new(&rasterizer)?,
            steps: 0,
            encode_time: Duration::ZERO,
            adam: GpuBuffer::uniform(gpu, "Adam", &AdamSetup::zeroed())?,
            loss_setup: GpuBuffer::uniform(gpu, "loss setup", &LossSetup::zeroed())?,
            images: Vec::new(),
            loss_total: GpuBuffer::computed_uniform(gpu, "loss", 16)?,
            rasterizer,
        })
    }

    /// For each view in turn: renders the map, compares it with the target, and moves the Gaussians that were blended by one step of
    /// Adam. The steps are submitted without waiting in between; what they report is read at the end. A step whose intersections did not
    /// fit moved nothing and is repeated after the others, with larger buffers.
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
        let gpu = self.rasterizer.gpu().clone();
        let log = GpuBuffer::storage(&gpu, "step log", (views.len() * std::mem::size_of::<StepLog>()) as u64)?;
        let mut reports = vec![StepReport::default(); views.len()];
        let mut pending: Vec<usize> = (0..views.len()).collect();
        while !pending.is_empty() {
            for (entry, &i) in pending.iter().enumerate() {
                let TrainingView { camera, scored, lr_scale, tile_sampling, .. } = &views[i];
                let view = TrainingView { tile_sampling: tile_sampling.filter(|_| scored.is_none()), ..views[i] };
                let objective = Objective::Image { view, loss };
                let started = Instant::now();
                self.adam.write(&gpu, 0, &[adam.setup(self.steps, *lr_scale)]);
                let mut encoder = gpu.device.create_command_encoder(&Default::default());
                self.encode(&mut encoder, cloud, &Viewpoint { camera, background: [0.0; 3] }, &objective, &Sink::Adam)?;
                self.steps += 1;
                self.encode_log(&mut encoder, &log, entry);
                gpu.queue.submit([encoder.finish()]);
                self.encode_time += started.elapsed();
            }
            let entries: Vec<StepLog> = log.read(&gpu, 0, pending.len())?;
            let mut repeat = Vec::new();
            for (&i, entry) in pending.iter().zip(&entries) {
                match self.rasterizer.counts(&entry.counters) {
                    Some(counts) => {
                        let pixels = views[i].target.width * views[i].target.height;
                        let loss = LossTerms::from_sums(entry.loss, pixels);
                        reports[i] = StepReport { loss, counts };
                    }
                    None => repeat.push(i),
                }
            }
            for entry in &entries {
                self.rasterizer.reserve_for(&entry.counters)?;
            }
            pending = repeat;
        }
        Ok(reports)
    }

    /// Renders a view over `background` and reads it back.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, cloud: &GpuCloud, camera: &ViewCamera, background: [f32; 3]) -> Result<Rendered, GpuError> {
        self.rasterizer.render(cloud, camera, background)
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

    /// The same, but returns the gradients and moves nothing.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn gradients(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        target: &TargetImage,
        loss: &LossConfig,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let objective = Objective::Image { view: TrainingView::new(*camera, target), loss };
        let mut gradients = self.collect(cloud, camera, [0.0; 3], &objective)?;
        gradients.loss = self.read_loss(&gpu, target)?;
        Ok(gradients)
    }

    /// Gradients of any loss by the map, from its gradients by the image; moves nothing.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn gradients_from_image(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        background: [f32; 3],
        by_image: &ImageGradients,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let Pinhole { width, height, .. } = camera.pinhole;
        image_buffers::choose(&mut self.images, &gpu, (width, height))?;
        self.images[0].gradients.write(&gpu, 0, &by_image.color_depth);
        let alpha: Vec<[f32; 4]> = by_image.alpha.iter().map(|a| [*a, 0.0, 0.0, 0.0]).collect();
        self.images[0].gradients.write(&gpu, by_image.color_depth.len(), &alpha);
        self.collect(cloud, camera, background, &Objective::Given)
    }

    fn collect(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        background: [f32; 3],
        objective: &Objective<'_>,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let sink = GpuBuffer::storage(&gpu, "gradients", cloud.parameters().raw().size())?;
        self.run(cloud, &Viewpoint { camera, background }, objective, &Sink::Gradient(&sink))?;
        let planes = (0..cloud.planes())
            .map(|plane| sink.read(&gpu, plane * cloud.capacity(), cloud.len()))
            .collect::<Result<Vec<_>, _>>()?;
        let cloud = cloud_from_planes(cloud.sh_degree(), &planes);
        Ok(Gradients { loss: LossTerms::default(), cloud })
    }

    /// Submits one step and waits, again with larger buffers if its intersections did not fit.
    fn run(
        &mut self,
        cloud: &GpuCloud,
        viewpoint: &Viewpoint<'_>,
        objective: &Objective<'_>,
        sink: &Sink<'_>,
    ) -> Result<(), GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        loop {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            self.encode(&mut encoder, cloud, viewpoint, objective, sink)?;
            gpu.queue.submit([encoder.finish()]);
            if self.rasterizer.finish()?.is_some() {
                return Ok(());
            }
        }
    }

    /// Encodes one whole step.
    fn encode(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        cloud: &GpuCloud,
        viewpoint: &Viewpoint<'_>,
        objective: &Objective<'_>,
        sink: &Sink<'_>,
    ) -> Result<(), GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let prepared = self.rasterizer.prepare(cloud, viewpoint.camera, viewpoint.background)?;
        image_buffers::choose(&mut self.images, &gpu, (prepared.view.width, prepared.view.height))?;
        self.rasterizer.encode_clear(encoder);
        if let Objective::Image { view: TrainingView { target, streamed, .. }, .. } = objective {
            match (&target.pixels, streamed) {
                (Some(pixels), _) => self.images[0].target.encode_copy(encoder, pixels),
                (None, streamed) => self.images[0].target.write(&gpu, streamed.expect("a view brings an offloaded target along")),
            }
            copy(encoder, &target.tile_losses, &self.images[0].loss_sums);
        }
        if let Sink::Gradient(buffer) = sink {
            encoder.clear_buffer(buffer.raw(), 0, None);
        }
        let mut pass = encoder.begin_compute_pass(&Default::default());
        if let Objective::Image { view: TrainingView { tile_sampling: Some(sampling), .. }, loss } = objective {
            self.sampler.encode_sample(&mut pass, &self.rasterizer, &self.images[0], loss, sampling, self.steps as u32);
        }
        self.rasterizer.encode_forward(&mut pass, cloud.parameters(), &prepared);
        if let Objective::Image { view, loss } = objective {
            if view.tile_sampling.is_some() {
                self.sampler.encode_fill(&mut pass, &self.rasterizer, &self.images[0], &self.loss_setup);
            }
            self.encode_loss(&mut pass, loss, view);
            let image = ScoredImage { gradients: &self.images[0].gradients, loss_total: &self.loss_total, loss };
            view.scored.iter().for_each(|pixels| self.scores.encode(&mut pass, &self.rasterizer, &prepared, &image, pixels));
        }
        self.encode_backward(&mut pass, cloud, &prepared, sink);
        gpu.mark(&mut pass, Self::END_MARK);
        drop(pass);
        if let Objective::Image { view, .. } = objective {
            copy(encoder, &self.images[0].loss_sums, &view.target.tile_losses);
        }
        Ok(())
    }

    fn read_loss(&self, gpu: &Gpu, target: &TargetImage) -> Result<LossTerms, GpuError> {
        let total: Vec<[f32; 4]> = self.loss_total.read(gpu, 0, 1)?;
        Ok(LossTerms::from_sums(total[0], target.width * target.height))
    }
}

/// A camera and the colour behind the map, linear RGB.
struct Viewpoint<'a> {
    camera: &'a ViewCamera,
    background: [f32; 3],
}

fn copy(encoder: &mut wgpu::CommandEncoder, from: &GpuBuffer, to: &GpuBuffer) {
    encoder.copy_buffer_to_buffer(from.raw(), 0, to.raw(), 0, from.raw().size());
}
