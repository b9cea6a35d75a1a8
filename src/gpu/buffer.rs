//! Buffers that count themselves, refuse impossible sizes, and read back.

use std::sync::Arc;

use bytemuck::Pod;
use wgpu::BufferUsages;

use super::device::MemoryCount;
use super::{Gpu, GpuError};

/// A GPU buffer with its place in the memory count.
#[derive(Debug)]
pub struct GpuBuffer {
    raw: wgpu::Buffer,
    memory: Arc<MemoryCount>,
    /// Tells this buffer from every other; gone when it is.
    identity: Arc<()>,
}

impl GpuBuffer {
    /// Storage of `bytes` (rounded up, zeroed) that can be written, copied and used for indirect dispatch.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn storage(gpu: &Gpu, label: &str, bytes: u64) -> Result<Self, GpuError> {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC | BufferUsages::INDIRECT;
        Self::create(gpu, label, bytes, usage, gpu.max_storage_bytes())
    }

    /// Storage that other shaders read as a uniform: a few numbers that one pass computes for the next.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn computed_uniform(gpu: &Gpu, label: &str, bytes: u64) -> Result<Self, GpuError> {
        let usage = BufferUsages::STORAGE | BufferUsages::UNIFORM | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        Self::create(gpu, label, bytes, usage, gpu.device.limits().max_uniform_buffer_binding_size)
    }

    /// A uniform that holds `value`.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn uniform<T: Pod>(gpu: &Gpu, label: &str, value: &T) -> Result<Self, GpuError> {
        let bytes = std::mem::size_of::<T>() as u64;
        let limit = gpu.device.limits().max_uniform_buffer_binding_size;
        let buffer = Self::create(gpu, label, bytes, BufferUsages::UNIFORM | BufferUsages::COPY_DST, limit)?;
        buffer.write(gpu, 0, std::slice::from_ref(value));
        Ok(buffer)
    }

    fn create(gpu: &Gpu, label: &str, bytes: u64, usage: BufferUsages, limit: u64) -> Result<Self, GpuError> {
        let size = bytes.max(16).next_multiple_of(16);
        if size > limit {
            return Err(GpuError::TooLarge { label: label.into(), needed: size, limit });
        }
        let raw = allocate(gpu, label, size, usage)?;
        gpu.memory.add(size);
        Ok(Self { raw, memory: gpu.memory.clone(), identity: Arc::default() })
    }

    pub(super) fn identity(&self) -> &Arc<()> {
        &self.identity
    }

    /// The wgpu buffer.
    pub fn raw(&self) -> &wgpu::Buffer {
        &self.raw
    }

    /// Writes `values` from element `first` (of their own size) on; it takes effect before the next submission.
    pub fn write<T: Pod>(&self, gpu: &Gpu, first: usize, values: &[T]) {
        if !values.is_empty() {
            gpu.queue.write_buffer(&self.raw, (first * std::mem::size_of::<T>()) as u64, bytemuck::cast_slice(values));
        }
    }

    /// Waits for all work and reads `count` elements from element `first` on.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn read<T: Pod>(&self, gpu: &Gpu, first: usize, count: usize) -> Result<Vec<T>, GpuError> {
        let element = std::mem::size_of::<T>();
        let bytes = (count * element) as u64;
        if bytes == 0 {
            return Ok(Vec::new());
        }
        let staging = allocate(gpu, "readback", bytes, BufferUsages::MAP_READ | BufferUsages::COPY_DST)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.raw, (first * element) as u64, &staging, 0, bytes);
        gpu.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        gpu.wait()?;
        let view = staging.get_mapped_range(..).map_err(|e| GpuError::Failed(e.to_string()))?;
        // The mapping has no alignment that a cast could rely on.
        Ok(view.chunks_exact(element).map(bytemuck::pod_read_unaligned).collect())
    }
}

impl Gpu {
    /// Whether buffers of so many bytes in all can be had at present, found out by having them.
    pub fn has_room(&self, bytes: u64) -> bool {
        let largest = self.max_storage_bytes();
        let sizes = (0..bytes.div_ceil(largest)).map(|i| largest.min(bytes - i * largest));
        let pieces = sizes.map(|size| allocate(self, "trial", size.next_multiple_of(16), BufferUsages::STORAGE));
        !self.memory.is_beyond(bytes) && pieces.collect::<Result<Vec<_>, _>>().is_ok()
    }
}

/// A wgpu buffer. An adapter without the memory for it refuses at once, and goes on working.
fn allocate(gpu: &Gpu, label: &str, size: u64, usage: BufferUsages) -> Result<wgpu::Buffer, GpuError> {
    if gpu.memory.is_beyond(size) {
        return Err(GpuError::OutOfMemory(label.into()));
    }
    let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
    let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
    let raw = gpu.device.create_buffer(&descriptor);
    let refused = pollster::block_on(scope.pop());
    refused.map_or(Ok(raw), |error| Err(GpuError::OutOfMemory(format!("{label}: {error}"))))
}

impl Drop for GpuBuffer {
    fn drop(&mut self) {
        self.memory.remove(self.raw.size());
        // Not when the last bind group over it goes: kernels keep theirs until they need another.
        self.raw.destroy();
    }
}
