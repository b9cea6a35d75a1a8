//! Scores of the Gaussians over some views, for density control: computed beside a training step, from its own tile lists and gradients.

use super::LossConfig;
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel, Part, UniformCell};
use crate::render::layout::{Counter, ScoreSetup, VISIBLE_COUNTER};
use crate::render::{BlendForm, GpuCloud, PreparedView, Rasterizer, shaders};

/// Definition of an error pixel (the high-error mask of FastGS).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorPixels {
    /// Its error exceeds the view's mean error this many times,
    pub error_ratio: f32,
    /// and is no noise: mean absolute colour error, 0 to 1.
    pub noise: f32,
}

impl ErrorPixels {
    /// The GPU's copy.
    pub(super) fn setup(&self, loss: &LossConfig, pixels: u32) -> ScoreSetup {
        let Self { error_ratio, noise } = *self;
        ScoreSetup { error_ratio, noise, ssim_weight: loss.ssim_weight, pixels: pixels as f32 }
    }
}

/// What some views say of one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GaussianScore {
    /// Error pixels into which it was blended, over all views.
    pub error_pixels: f32,
    /// The same, each view's times the view's loss.
    pub weighted_error_pixels: f32,
    /// Sum and maximum of what it added to a pixel, 0 to 1.
    pub weight_sum: f32,
    /// Maximum of the blending weights, 0 to 1.
    pub weight_max: f32,
    /// Sum over the views of the mean loss' gradient by its image position; normalised device coordinates, as 3DGS has it.
    pub gradient: f32,
    /// Sum over the views of its pixels' absolute gradients: of the loss summed over the image, for a pixel of motion.
    pub absolute_gradient: f32,
    /// Views that blended it.
    pub views: f32,
    /// Size of a pixel at its depth in the view nearest to it, metres.
    pub metres_per_pixel: f32,
}

/// A pass that follows scored steps in their submission, and what it leaves to be read.
pub trait OverScores {
    /// Encodes it; `scores` are `[2, capacity]` vec4 as `shaders/gather_scores.wgsl` has them.
    fn encode(&self, pass: &mut wgpu::ComputePass<'_>, scores: &GpuBuffer);

    /// To be read after it, u32 each.
    fn part(&self) -> Part<'_>;
}

/// A rendered image with its loss.
pub(super) struct ScoredImage<'a> {
    /// `[2, H, W]` gradients of the loss by the image.
    pub gradients: &'a GpuBuffer,
    /// The log of the step, which begins with the sums of the loss.
    pub log: &'a GpuBuffer,
}

/// The scoring passes and their buffers.
#[derive(Debug)]
pub(super) struct Scores {
    rasterize: Kernel,
    gather: Kernel,
    /// [2, capacity]
    scores: GpuBuffer,
    capacity: usize,
}

impl Scores {
    pub fn new(rasterizer: &Rasterizer) -> Result<Self, GpuError> {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(rasterizer.blending()));
        Ok(Self {
            rasterize: kernel(match form {
                BlendForm::Wide => &shaders::RASTERIZE_SCORES_WIDE,
                BlendForm::Narrow => &shaders::RASTERIZE_SCORES_NARROW,
            }),
            gather: kernel(&shaders::GATHER_SCORES),
            scores: GpuBuffer::storage(gpu, "scores", 16)?,
            capacity: 0,
        })
    }

    /// Forgets all views; the cloud must not change until the scores are read.
    pub fn clear(&mut self, gpu: &Gpu, cloud: &GpuCloud) -> Result<(), GpuError> {
        self.reserve(gpu, cloud.capacity())
    }

    /// Room for so many Gaussians, zeroed.
    pub fn reserve(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        if capacity == self.capacity {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            gpu.clear(&mut encoder, &self.scores, 0, None);
            gpu.submit(encoder);
            return Ok(());
        }
        self.scores = GpuBuffer::storage(gpu, "scores", capacity as u64 * 32)?;
        self.capacity = capacity;
        Ok(())
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Adds the scores of a view whose loss and its gradient are there, before the backward pass.
    pub fn encode(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        prepared: &PreparedView,
        image: &ScoredImage<'_>,
        setup: UniformCell,
    ) {
        let (gpu, ws) = (rasterizer.gpu(), &rasterizer.workspace);
        let (view, setup) = (rasterizer.view(prepared), rasterizer.uniforms.of(setup));
        let rasterize = [(7, image.gradients), (8, &ws.intersection_gradients), (9, setup), (10, image.log)];
        rasterizer.encode_over_lists(pass, prepared, &self.rasterize, &rasterize);
        let gather = [
            (0, view),
            (1, &ws.counters),
            (2, &ws.intersection_counts),
            (3, &ws.intersection_gradients),
            (4, &ws.projected),
            (5, &self.scores),
            (6, setup),
            (7, image.log),
        ];
        let visible = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        self.gather.dispatch_indirect(gpu, pass, &gather, visible);
    }

    /// `[2, capacity]` vec4: the sums over all views since the last clearing.
    pub fn buffer(&self) -> &GpuBuffer {
        &self.scores
    }

    /// The same, of all Gaussians.
    pub fn read(&self, gpu: &Gpu, cloud: &GpuCloud) -> Result<Vec<GaussianScore>, GpuError> {
        assert_eq!(self.capacity, cloud.capacity(), "the scores are those of this cloud");
        let read = gpu.read(None, &[0, self.capacity].map(|first| self.scores.part::<[f32; 4]>(first, cloud.len())))?;
        Ok(read.part(0).into_iter().zip(read.part(1)).map(GaussianScore::from_planes).collect())
    }
}

impl GaussianScore {
    /// One from its two vectors, see `shaders/gather_scores.wgsl`.
    fn from_planes((seen, by_view): ([f32; 4], [f32; 4])) -> Self {
        Self {
            error_pixels: seen[0],
            weighted_error_pixels: seen[1],
            weight_sum: seen[2],
            weight_max: seen[3],
            gradient: by_view[0],
            absolute_gradient: by_view[1],
            views: by_view[2],
            metres_per_pixel: by_view[3],
        }
    }
}
