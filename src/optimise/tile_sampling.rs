//! Stochastic tile sampling: which tiles of a view a step uses, and what stands in place of the others.

use serde::Serialize;

use super::LossConfig;
use super::loss::TargetBuffers;
use crate::gpu::{GpuBuffer, Kernel, UniformCell, workgroups};
use crate::render::layout::TileSamplingSetup;
use crate::render::{PreparedView, Rasterizer, shaders};

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
}

impl TileSampler {
    pub fn new(rasterizer: &Rasterizer) -> Self {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(form));
        Self { sample: kernel(&shaders::SAMPLE_TILES), fill: kernel(&shaders::FILL_UNSAMPLED) }
    }

    /// Draws the tiles of the step, before the forward rendering.
    pub fn encode_sample(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        prepared: &PreparedView,
        tile_losses: &GpuBuffer,
        setup: UniformCell,
    ) {
        let (view, setup) = (rasterizer.view(prepared), rasterizer.uniforms.of(setup));
        let bindings = [(0, view), (1, setup), (2, tile_losses), (3, rasterizer.unsampled(prepared))];
        self.sample.dispatch(rasterizer.gpu(), pass, &bindings, [1, 1, 1]);
    }

    /// Copies the recorded image into unsampled tiles, before the loss.
    pub fn encode_fill(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        prepared: &PreparedView,
        target: &TargetBuffers<'_>,
        loss_setup: UniformCell,
    ) {
        let (view, setup, ws) = (rasterizer.view(prepared), rasterizer.uniforms.of(loss_setup), &rasterizer.workspace);
        let bindings = [(0, view), (1, rasterizer.unsampled(prepared)), (2, target.color), (3, &ws.color_depth), (4, setup)];
        self.fill.dispatch(rasterizer.gpu(), pass, &bindings, workgroups(prepared.view.tiles()));
    }
}

impl TileSampling {
    /// The GPU's copy; `seed` is that of the draw.
    pub(super) fn setup(&self, loss: &LossConfig, seed: u32) -> TileSamplingSetup {
        let Self { share, min_share, noise } = *self;
        let LossConfig { ssim_weight, depth_weight, .. } = *loss;
        TileSamplingSetup { share, min_share, noise, ssim_weight, depth_weight, seed }
    }
}
