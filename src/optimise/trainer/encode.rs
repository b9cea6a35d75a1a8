//! The passes after the forward rendering, encoded: loss and backward.

use super::{Sink, Trainer, TrainingView};
use crate::gpu::{GpuBuffer, IndirectSize, UniformCell};
use crate::optimise::LossConfig;
use crate::optimise::image_buffers::LOSS_TILE;
use crate::optimise::loss::{GpuPixels, ssim_phase};
use crate::render::layout::{Counter, INTERSECTION_COUNTER, LossSetup, VISIBLE_COUNTER};
use crate::render::{GpuCloud, PreparedView};

/// Uniforms of a step beside its view.
pub(super) struct StepUniforms {
    pub loss: UniformCell,
    pub scores: Option<UniformCell>,
    /// Of a planar surface.
    pub surface: Option<UniformCell>,
}

impl Trainer {
    pub(super) fn put_uniforms(&mut self, view: &TrainingView<'_>, loss: &LossConfig, prepared: &PreparedView) -> StepUniforms {
        let (width, height) = (prepared.view.width, prepared.view.height);
        let LossConfig { ssim_weight, depth_weight, precise_depth_metres: precise_depth } = *loss;
        let [phase_x, phase_y] = ssim_phase(self.steps);
        let windows = |size: u32, phase: u32| (size + 1 - phase) / 2;
        let pixels_per_window = (width * height) as f32 / (windows(width, phase_x) * windows(height, phase_y)).max(1) as f32;
        let [red_gain, green_gain, blue_gain] = view.exposure.gains().recip().to_array();
        let setup = LossSetup {
            width,
            height,
            ssim_weight,
            depth_weight,
            precise_depth,
            depth_confidence: view.depth_confidence,
            phase_x,
            phase_y,
            pixels_per_window,
            red_gain,
            green_gain,
            blue_gain,
        };
        let is_planar = self.rasterizer.blending().is_planar();
        let uniforms = &mut self.rasterizer.uniforms;
        StepUniforms {
            surface: is_planar.then(|| uniforms.put(&self.planar.setup(view.surface_share / prepared.view.pixels() as f32))),
            loss: uniforms.put(&setup),
            scores: view.scored.map(|pixels| uniforms.put(&pixels.setup(loss, prepared.view.pixels()))),
        }
    }

    pub(super) fn encode_loss(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        prepared: &PreparedView,
        target: &GpuPixels,
        cells: &StepUniforms,
        log: &GpuBuffer,
    ) {
        let (gpu, ws, k) = (self.rasterizer.gpu(), &self.rasterizer.workspace, &self.kernels);
        let (width, height) = (prepared.view.width, prepared.view.height);
        let size = [width.div_ceil(LOSS_TILE), height.div_ceil(LOSS_TILE), 1];
        let inputs = [
            (0, self.rasterizer.uniforms.of(cells.loss)),
            (1, &ws.color_depth),
            (2, &ws.state),
            (3, &target.color),
            (4, &target.depth),
            (5, &self.images[0].partials),
        ];
        let loss_sums = &self.images[0].loss_sums;
        let with = |last| inputs.iter().copied().chain([last]).collect::<Vec<_>>();
        k.loss_forward.dispatch(gpu, pass, &with((6, loss_sums)), size);
        k.loss_reduce.dispatch(gpu, pass, &[(0, loss_sums), (1, &ws.counters), (2, log)], [1, 1, 1]);
        k.loss_backward.dispatch(gpu, pass, &with((6, &self.images[0].gradients)), size);
        if let Some((kernel, cell)) = k.surface_loss.as_ref().zip(cells.surface) {
            let inputs = [
                (0, self.rasterizer.view(prepared)),
                (1, self.rasterizer.uniforms.of(cell)),
                (2, &ws.color_depth),
                (3, &ws.state),
                (4, &self.images[0].gradients),
            ];
            kernel.dispatch(gpu, pass, &inputs, size);
        }
    }

    pub(super) fn encode_backward(
        &mut self,
        pass: &mut wgpu::ComputePass<'_>,
        cloud: &GpuCloud,
        prepared: &PreparedView,
        sink: &Sink<'_>,
    ) {
        let is_planar = self.rasterizer.blending().is_planar();
        let thickness = is_planar.then_some(self.planar.thickness);
        let adam = match sink {
            Sink::Adam(adam) => Some(self.rasterizer.uniforms.put(&adam.setup(self.steps, thickness, cloud.frozen()))),
            Sink::Gradient(_) => None,
        };
        let (gpu, ws, k) = (self.rasterizer.gpu(), &self.rasterizer.workspace, &self.kernels);
        let view = self.rasterizer.view(prepared);
        let blend = [(7, &self.images[0].gradients), (8, &ws.intersection_gradients)];
        self.rasterizer.encode_over_lists(pass, prepared, &k.rasterize_backward, &blend);
        if self.rasterizer.form().slot_chunk() > 1 {
            let slots = [(0, &ws.counters), (1, &ws.slot_gaussians), (2, &ws.intersection_gradients)];
            let size = IndirectSize { buffer: &ws.counters, offset: Counter::per_block_offset(INTERSECTION_COUNTER) };
            k.sum_slots.dispatch_indirect(gpu, pass, &slots, size);
        }
        let project = [
            (0, view),
            (1, &ws.counters),
            (2, &ws.intersection_counts),
            (3, &ws.intersection_gradients),
            (4, cloud.parameters()),
        ];
        let arguments = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        let (kernel, rest) = match (sink, adam) {
            (Sink::Gradient(buffer), _) => (&k.project_backward, vec![(5, *buffer)]),
            (Sink::Adam(_), adam) => {
                let adam = self.rasterizer.uniforms.of(adam.expect("put above"));
                let moments = [(5, cloud.moments_1()), (6, cloud.moments_2()), (7, adam), (8, cloud.averages())];
                (&k.project_backward_adam, moments.to_vec())
            }
        };
        kernel.dispatch_indirect(gpu, pass, &project.into_iter().chain(rest).collect::<Vec<_>>(), arguments);
    }
}
