//! The passes after the forward rendering, encoded: loss, backward, and the log of the step.

use super::{Sink, StepLog, Trainer, TrainingView};
use crate::gpu::{GpuBuffer, IndirectSize};
use crate::optimise::LossConfig;
use crate::optimise::image_buffers::LOSS_TILE;
use crate::optimise::loss::{GpuPixels, ssim_phase};
use crate::render::layout::{Counter, LossSetup, VISIBLE_COUNTER};
use crate::render::{GpuCloud, PreparedView};

impl Trainer {
    pub(super) fn encode_log(&self, encoder: &mut wgpu::CommandEncoder, log: &GpuBuffer, entry: usize) {
        let to = (entry * std::mem::size_of::<StepLog>()) as u64;
        let counters = &self.rasterizer.workspace.counters;
        let counters_at = std::mem::offset_of!(StepLog, counters) as u64;
        encoder.copy_buffer_to_buffer(self.loss_total.raw(), 0, log.raw(), to, counters_at);
        encoder.copy_buffer_to_buffer(counters.raw(), 0, log.raw(), to + counters_at, counters.raw().size());
    }

    pub(super) fn encode_loss(&self, pass: &mut wgpu::ComputePass<'_>, loss: &LossConfig, view: &TrainingView<'_>) {
        let (gpu, ws, k) = (self.rasterizer.gpu(), &self.rasterizer.workspace, &self.kernels);
        let ((width, height), GpuPixels { color, depth }) = (self.images[0].size, &self.images[0].target);
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
        self.loss_setup.write(gpu, 0, &[setup]);
        let forward = [width.div_ceil(LOSS_TILE), height.div_ceil(LOSS_TILE / 2), 1];
        let backward = [width.div_ceil(LOSS_TILE), height.div_ceil(LOSS_TILE), 1];
        let inputs =
            [(0, &self.loss_setup), (1, &ws.color_depth), (2, &ws.state), (3, color), (4, depth), (5, &self.images[0].partials)];
        let with = |last| inputs.iter().copied().chain([last, (7, &ws.unsampled)]).collect::<Vec<_>>();
        k.loss_forward.dispatch(gpu, pass, &with((6, &self.images[0].loss_sums)), forward);
        k.loss_reduce.dispatch(gpu, pass, &[(0, &self.images[0].loss_sums), (1, &self.loss_total)], [1, 1, 1]);
        k.loss_backward.dispatch(gpu, pass, &with((6, &self.images[0].gradients)), backward);
    }

    pub(super) fn encode_backward(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        cloud: &GpuCloud,
        prepared: &PreparedView,
        sink: &Sink<'_>,
    ) {
        let (gpu, ws, k) = (self.rasterizer.gpu(), &self.rasterizer.workspace, &self.kernels);
        let blend = [
            (0, self.rasterizer.view()),
            (1, &ws.ranges),
            (2, &ws.slots[prepared.sorted]),
            (3, &ws.slot_gaussians),
            (4, &ws.projected),
            (5, &ws.color_depth),
            (6, &ws.state),
            (7, &self.images[0].gradients),
            (8, &ws.intersection_gradients),
        ];
        k.rasterize_backward.dispatch(gpu, pass, &blend, self.rasterizer.form().workgroups(prepared.view.tiles()));
        let mut project = vec![
            (0, self.rasterizer.view()),
            (1, &ws.counters),
            (2, &ws.intersection_counts),
            (3, &ws.intersection_gradients),
            (4, cloud.parameters()),
        ];
        let arguments = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        let kernel = match sink {
            Sink::Adam => {
                project.extend([(5, cloud.moments_1()), (6, cloud.moments_2()), (7, &self.adam), (8, cloud.averages())]);
                &k.project_backward_adam
            }
            Sink::Gradient(buffer) => {
                project.push((5, *buffer));
                &k.project_backward
            }
        };
        kernel.dispatch_indirect(gpu, pass, &project, arguments);
    }
}
