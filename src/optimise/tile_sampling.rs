//! Stochastic tile sampling: which tiles of a view a step uses, and what stands in place of the others.

use bytemuck::Zeroable;
use serde::Serialize;

use super::LossConfig;
use super::image_buffers::{self, ImageBuffers};
use crate::gpu::{GpuBuffer, GpuError, Kernel, workgroups};
use crate::render::layout::TileSamplingSetup;
use crate::render::{Rasterizer, shaders};

/// Which tiles of a view a step uses, by each tile's loss when last sampled. Tiles of unknown loss are always sampled.
/// The reported loss covers the whole view, with the last known loss of unsampled tiles.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TileSampling {
    /// Share of the steps that sample a tile of mean loss; other tiles in proportion to their loss.
    pub share: f32,
    /// Least share of the steps that sample a tile.
    pub min_share: f32,
    /// Loss per pixel below which a tile is sampled in no more than the least share.
    pub noise: f32,
}

/// The passes around the forward rendering.
#[derive(Debug)]
pub(super) struct TileSampler {
    sample: Kernel,
    fill: Kernel,
    setup: GpuBuffer,
}

impl TileSampler {
    pub fn new(rasterizer: &Rasterizer) -> Result<Self, GpuError> {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(form));
        Ok(Self {
            sample: kernel(&shaders::SAMPLE_TILES),
            fill: kernel(&shaders::FILL_UNSAMPLED),
            setup: GpuBuffer::uniform(gpu, "tile sampling", &TileSamplingSetup::zeroed())?,
        })
    }

    /// Draws the tiles of the step, before the forward rendering; `seed` is that of the draw.
    pub fn encode_sample(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        images: &ImageBuffers,
        loss: &LossConfig,
        sampling: &TileSampling,
        seed: u32,
    ) {
        let (gpu, ws) = (rasterizer.gpu(), &rasterizer.workspace);
        let TileSampling { share, min_share, noise } = *sampling;
        let LossConfig { ssim_weight, depth_weight, .. } = *loss;
        self.setup.write(gpu, 0, &[TileSamplingSetup { share, min_share, noise, ssim_weight, depth_weight, seed }]);
        let bindings = [(0, rasterizer.view()), (1, &self.setup), (2, &images.loss_sums), (3, &ws.unsampled)];
        self.sample.dispatch(gpu, pass, &bindings, [1, 1, 1]);
    }

    /// Copies the recorded image into unsampled tiles, before the loss.
    pub fn encode_fill(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        images: &ImageBuffers,
        loss_setup: &GpuBuffer,
    ) {
        let (gpu, ws, target) = (rasterizer.gpu(), &rasterizer.workspace, &images.target);
        let bindings = [(0, rasterizer.view()), (1, &ws.unsampled), (2, &target.color), (3, &ws.color_depth), (4, loss_setup)];
        let tiles = image_buffers::tiles(images.size) as u32;
        self.fill.dispatch(gpu, pass, &bindings, workgroups(tiles));
    }
}
