//! The adapter's bandwidth and arithmetic, measured.

use std::time::Instant;

use serde::Serialize;

use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, workgroups};
use crate::render::{BlendForm, shaders};

/// Bandwidth and arithmetic rate of the adapter, measured with the simplest kernels.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Rates {
    /// Bytes read plus bytes written per second, copying vec4.
    pub bytes_per_s: f64,
    /// Floating-point operations per second, two per fused multiply-add.
    pub flops_per_s: f64,
}

const COPY_BYTES: u64 = 64 << 20;
const RUNS: usize = 5;
/// Of one invocation of `multiply_add`: 4 lanes × 8 chains × 256 rounds × 2.
const FLOPS_PER_INVOCATION: f64 = 16_384.0;
/// Enough to keep any adapter busy for milliseconds.
const BUSY_S: f64 = 0.05;

/// Measures both rates; the best of a few runs each.
///
/// # Errors
/// [`GpuError`] if a buffer does not fit or the device fails.
pub fn measure_rates(gpu: &Gpu) -> Result<Rates, GpuError> {
    gpu.pause_profile(true);
    let rates = measure(gpu);
    gpu.pause_profile(false);
    rates
}

fn measure(gpu: &Gpu) -> Result<Rates, GpuError> {
    let text = shaders::RATES.text(BlendForm::default());
    let copy = Kernel::new(gpu, "copy_memory", "copy_memory", &text);
    let multiply_add = Kernel::new(gpu, "multiply_add", "multiply_add", &text);
    let source = GpuBuffer::storage(gpu, "rates source", COPY_BYTES)?;
    let sink = GpuBuffer::storage(gpu, "rates sink", COPY_BYTES)?;
    source.write(gpu, 0, &[[0.999f32; 4], [1e-3; 4]]);
    let groups = (COPY_BYTES / 16 / 256) as u32;
    // As often in one submission as takes long enough to time.
    let once_s = best(gpu, &copy, [&source, &sink], groups, 1)?;
    let copies = ((BUSY_S / once_s) as u32).clamp(1, 500);
    let copy_s = best(gpu, &copy, [&source, &sink], groups, copies)? / f64::from(copies);
    // A first guess of the work, then as much as takes long enough to time.
    let probe = 256;
    let probe_s = best(gpu, &multiply_add, [&source, &sink], probe, 1)?;
    let groups = ((f64::from(probe) * BUSY_S / probe_s) as u32).clamp(probe, 4_000_000);
    let fma_s = best(gpu, &multiply_add, [&source, &sink], groups, 1)?;
    Ok(Rates {
        bytes_per_s: 2.0 * COPY_BYTES as f64 / copy_s,
        flops_per_s: f64::from(groups) * 256.0 * FLOPS_PER_INVOCATION / fma_s,
    })
}

fn best(gpu: &Gpu, kernel: &Kernel, [source, sink]: [&GpuBuffer; 2], groups: u32, times: u32) -> Result<f64, GpuError> {
    let mut best = f64::INFINITY;
    for _ in 0..RUNS {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        (0..times).for_each(|_| kernel.dispatch(gpu, &mut pass, &[(0, source), (1, sink)], workgroups(groups)));
        drop(pass);
        let commands = encoder.finish();
        gpu.wait()?;
        let started = Instant::now();
        gpu.queue.submit([commands]);
        gpu.wait()?;
        best = best.min(started.elapsed().as_secs_f64());
    }
    Ok(best)
}
