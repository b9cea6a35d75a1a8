//! Leaving tiles out of a step: which ones, and what stands in their place.

use bytemuck::Zeroable;
use serde::Serialize;

use super::LossConfig;
use super::image_buffers::{self, ImageBuffers};
use crate::gpu::{GpuBuffer, GpuError, Kernel, workgroups};
use crate::render::layout::TileSkipSetup;
use crate::render::{Rasterizer, shaders};

/// Which tiles of a view a step leaves out, by their loss when each was last worked on; unknown ones never. The reported loss is
/// that of the whole view all the same, as far as it is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TileSkip {
    /// A tile whose loss is the view's mean is worked on in this share of the steps, one of more loss in proportion more often,
    pub share: f32,
    /// each in this share at least,
    pub least: f32,
    /// and one of less loss than this per pixel no more often.
    pub noise: f32,
}

/// The passes around the forward rendering.
#[derive(Debug)]
pub(super) struct SkippedTiles {
    select: Kernel,
    fill: Kernel,
    setup: GpuBuffer,
}

impl SkippedTiles {
    pub fn new(rasterizer: &Rasterizer) -> Result<Self, GpuError> {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(form));
        Ok(Self {
            select: kernel(&shaders::SELECT_TILES),
            fill: kernel(&shaders::FILL_SKIPPED),
            setup: GpuBuffer::uniform(gpu, "tile skip", &TileSkipSetup::zeroed())?,
        })
    }

    /// Chooses the tiles to leave out, before the forward rendering; `seed` is that of the draw.
    pub fn encode_select(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        images: &ImageBuffers,
        loss: &LossConfig,
        (skip, seed): &(TileSkip, u32),
    ) {
        let (gpu, ws) = (rasterizer.gpu(), &rasterizer.workspace);
        let TileSkip { share, least, noise } = *skip;
        let LossConfig { ssim_weight, depth_weight, .. } = *loss;
        self.setup.write(gpu, 0, &[TileSkipSetup { share, least, noise, ssim_weight, depth_weight, seed: *seed }]);
        let bindings = [(0, rasterizer.view()), (1, &self.setup), (2, &images.loss_sums), (3, &ws.skipped)];
        self.select.dispatch(gpu, pass, &bindings, [1, 1, 1]);
    }

    /// Puts what was recorded in place of the tiles left out, before the loss.
    pub fn encode_fill(&self, pass: &mut wgpu::ComputePass<'_>, rasterizer: &Rasterizer, images: &ImageBuffers) {
        let (gpu, ws, target) = (rasterizer.gpu(), &rasterizer.workspace, &images.target);
        let bindings = [(0, rasterizer.view()), (1, &ws.skipped), (2, &target.color), (3, &ws.color_depth)];
        let tiles = image_buffers::tiles((target.width, target.height)) as u32;
        self.fill.dispatch(gpu, pass, &bindings, workgroups(tiles));
    }
}
