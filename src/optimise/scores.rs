//! Scores of the Gaussians over some views, for density control: computed beside a training step, from its own tile lists and gradients.

use super::LossConfig;
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel};
use crate::render::layout::{Counter, ScoreSetup, VISIBLE_COUNTER};
use crate::render::{GpuCloud, PreparedView, Rasterizer, shaders};

use bytemuck::Zeroable;

/// Definition of an error pixel (the high-error mask of FastGS).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorPixels {
    /// Its error exceeds the view's mean error this many times,
    pub error_ratio: f32,
    /// and is no noise: mean absolute colour error, 0 to 1.
    pub noise: f32,
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
    /// Sums over the views of the loss gradient by its image position, and of the sums of absolute gradients over its pixels;
    /// normalised device coordinates, as 3DGS has them.
    pub gradient: f32,
    /// Sum of absolute image-position gradients, normalised device coordinates.
    pub absolute_gradient: f32,
    /// Views that blended it.
    pub views: f32,
    /// Size of a pixel at its depth in the view nearest to it, metres.
    pub metres_per_pixel: f32,
}

/// A rendered image with its loss.
pub(super) struct ScoredImage<'a> {
    /// `[2, H, W]` gradients of the loss by the image.
    pub gradients: &'a GpuBuffer,
    pub loss_total: &'a GpuBuffer,
    pub loss: &'a LossConfig,
}

/// The scoring passes and their buffers.
#[derive(Debug)]
pub(super) struct Scores {
    rasterize: Kernel,
    gather: Kernel,
    setup: GpuBuffer,
    /// [2, capacity]
    scores: GpuBuffer,
    capacity: usize,
}

impl Scores {
    pub fn new(rasterizer: &Rasterizer) -> Result<Self, GpuError> {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(form));
        Ok(Self {
            rasterize: kernel(&shaders::RASTERIZE_SCORES),
            gather: kernel(&shaders::GATHER_SCORES),
            setup: GpuBuffer::uniform(gpu, "score setup", &ScoreSetup::zeroed())?,
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
            encoder.clear_buffer(self.scores.raw(), 0, None);
            gpu.queue.submit([encoder.finish()]);
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
        wrong: &ErrorPixels,
    ) {
        let (gpu, ws) = (rasterizer.gpu(), &rasterizer.workspace);
        let pixels = prepared.view.pixels() as f32;
        let setup =
            ScoreSetup { error_ratio: wrong.error_ratio, noise: wrong.noise, ssim_weight: image.loss.ssim_weight, pixels };
        self.setup.write(gpu, 0, &[setup]);
        let rasterize = [
            (0, rasterizer.view()),
            (1, &ws.ranges),
            (2, &ws.slots[prepared.sorted]),
            (3, &ws.slot_gaussians),
            (4, &ws.projected),
            (5, &ws.color_depth),
            (6, &ws.state),
            (7, image.gradients),
            (8, &ws.intersection_gradients),
            (9, &self.setup),
            (10, image.loss_total),
        ];
        self.rasterize.dispatch(gpu, pass, &rasterize, rasterizer.form().workgroups(prepared.view.tiles()));
        let gather = [
            (0, rasterizer.view()),
            (1, &ws.counters),
            (2, &ws.intersection_counts),
            (3, &ws.intersection_gradients),
            (4, &ws.projected),
            (5, &self.scores),
            (6, &self.setup),
            (7, image.loss_total),
        ];
        let visible = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        self.gather.dispatch_indirect(gpu, pass, &gather, visible);
    }

    /// The sums over all views since the last clearing, `[N]` in map order.
    pub fn read(&self, gpu: &Gpu, cloud: &GpuCloud) -> Result<Vec<GaussianScore>, GpuError> {
        assert_eq!(self.capacity, cloud.capacity(), "the scores are those of this cloud");
        let seen: Vec<[f32; 4]> = self.scores.read(gpu, 0, cloud.len())?;
        let gradients: Vec<[f32; 4]> = self.scores.read(gpu, self.capacity, cloud.len())?;
        let score = |(s, g): (&[f32; 4], &[f32; 4])| GaussianScore {
            error_pixels: s[0],
            weighted_error_pixels: s[1],
            weight_sum: s[2],
            weight_max: s[3],
            gradient: g[0],
            absolute_gradient: g[1],
            views: g[2],
            metres_per_pixel: g[3],
        };
        Ok(seen.iter().zip(&gradients).map(score).collect())
    }
}
