//! Times on the GPU: a timestamp before each dispatch, where the adapter can.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use super::{Gpu, GpuError};

/// Timestamps between two readings; what comes beyond is not recorded.
const MAX_MARKS: usize = 2048;

#[derive(Debug)]
pub(super) struct Profiler {
    queries: wgpu::QuerySet,
    marks: Mutex<Vec<&'static str>>,
    paused: AtomicBool,
}

impl Profiler {
    pub(super) const FEATURES: wgpu::Features =
        wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES);

    pub(super) fn new(device: &wgpu::Device) -> Self {
        let descriptor =
            wgpu::QuerySetDescriptor { label: Some("profile"), ty: wgpu::QueryType::Timestamp, count: MAX_MARKS as u32 };
        Self { queries: device.create_query_set(&descriptor), marks: Mutex::default(), paused: AtomicBool::default() }
    }
}

impl Gpu {
    /// Notes the time at which `label` begins, and what came before it ends. Costs nothing unless profiling.
    pub fn mark(&self, pass: &mut wgpu::ComputePass<'_>, label: &'static str) {
        let Some(profiler) = self.profiler.as_ref().filter(|profiler| !profiler.paused.load(Ordering::Relaxed)) else { return };
        let mut marks = profiler.marks.lock().unwrap_or_else(PoisonError::into_inner);
        if marks.len() < MAX_MARKS {
            pass.write_timestamp(&profiler.queries, marks.len() as u32);
            marks.push(label);
        }
    }

    /// Whether marks are recorded at all.
    pub fn has_profile(&self) -> bool {
        self.profiler.is_some()
    }

    /// Whether to leave out the marks from now on: each one drains the adapter between two dispatches that might overlap.
    pub fn pause_profile(&self, paused: bool) {
        if let Some(profiler) = &self.profiler {
            profiler.paused.store(paused, Ordering::Relaxed);
        }
    }

    /// Waits and returns `(label, milliseconds)` of everything marked since the last call, in order; `None` where the adapter or the
    /// way it was opened gives no timestamps. The last mark ends the one before it and has no time of its own.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn take_profile(&self) -> Result<Option<Vec<(&'static str, f64)>>, GpuError> {
        let Some(profiler) = &self.profiler else { return Ok(None) };
        let marks = std::mem::take(&mut *profiler.marks.lock().unwrap_or_else(PoisonError::into_inner));
        let bytes = (marks.len() * 8) as u64;
        let buffer = |usage| {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: bytes.max(8),
                usage,
                mapped_at_creation: false,
            })
        };
        let resolved = buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC);
        let staging = buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.resolve_query_set(&profiler.queries, 0..marks.len() as u32, &resolved, 0);
        encoder.copy_buffer_to_buffer(&resolved, 0, &staging, 0, bytes);
        self.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        self.wait()?;
        let view = staging.get_mapped_range(..).map_err(|e| GpuError::Failed(e.to_string()))?;
        let ticks: Vec<u64> = view.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect();
        let ms_per_tick = f64::from(self.queue.get_timestamp_period()) * 1e-6;
        let spans = ticks.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64 * ms_per_tick);
        Ok(Some(marks.into_iter().zip(spans).collect()))
    }
}
