//! Buffers that count themselves and refuse impossible sizes.

use std::sync::Arc;

use bytemuck::Pod;
use wgpu::BufferUsages;

use super::memory::MemoryCount;
use super::readback::Part;
use super::{Gpu, GpuError};

/// A GPU buffer with its place in the memory count, or a window on one.
#[derive(Debug)]
pub struct GpuBuffer {
    raw: wgpu::Buffer,
    /// Of a window: bytes from the start of the buffer.
    offset: u64,
    size: u64,
    /// Nothing for a window: the whole buffer is counted and destroyed.
    memory: Option<Arc<MemoryCount>>,
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
        let raw = allocate(gpu, label, size, usage, false)?;
        gpu.memory.add(size);
        Ok(Self { raw, offset: 0, size, memory: Some(gpu.memory.clone()), identity: Arc::default() })
    }

    /// A part of the buffer, to bind by itself; of no use once the buffer is gone.
    pub(crate) fn window(&self, offset: u64, size: u64) -> Self {
        assert!(offset + size <= self.size, "a window lies within its buffer");
        Self { raw: self.raw.clone(), offset: self.offset + offset, size, memory: None, identity: Arc::default() }
    }

    pub(super) fn identity(&self) -> &Arc<()> {
        &self.identity
    }

    /// The wgpu buffer; of a window, the whole one.
    pub fn raw(&self) -> &wgpu::Buffer {
        &self.raw
    }

    /// Length, bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    pub(super) fn binding(&self) -> wgpu::BindingResource<'_> {
        let size = std::num::NonZeroU64::new(self.size);
        wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer: &self.raw, offset: self.offset, size })
    }

    /// Writes `values` from element `first` (of their own size) on; it takes effect before the next submission.
    pub fn write<T: Pod>(&self, gpu: &Gpu, first: usize, values: &[T]) {
        let at = self.offset + (first * std::mem::size_of::<T>()) as u64;
        let bytes: &[u8] = bytemuck::cast_slice(values);
        gpu.upload(&self.raw, at, bytes.len() as u64, |mut to| to.copy_from_slice(bytes));
    }

    /// Writes `words` from the start on, without a copy of them on the host; it takes effect before the next submission.
    pub fn write_words(&self, gpu: &Gpu, words: impl ExactSizeIterator<Item = u32>) {
        gpu.upload(&self.raw, self.offset, words.len() as u64 * 4, |to| {
            to.into_chunks::<4>().0.into_iter().zip(words).for_each(|(to, word)| to.write(word.to_ne_bytes()));
        });
    }

    /// Elements `first` to before `first + count`, to be read with others by [`Gpu::read`].
    pub fn part<T: Pod>(&self, first: usize, count: usize) -> Part<'_> {
        let element = std::mem::size_of::<T>() as u64;
        Part { buffer: &self.raw, offset: self.offset + first as u64 * element, bytes: count as u64 * element }
    }

    /// Waits for all work and reads `count` elements from element `first` on.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn read<T: Pod>(&self, gpu: &Gpu, first: usize, count: usize) -> Result<Vec<T>, GpuError> {
        Ok(gpu.read(None, &[self.part::<T>(first, count)])?.part(0))
    }
}

impl Gpu {
    /// Whether buffers of so many bytes in all can be had at present, found out by having them.
    pub fn has_room(&self, bytes: u64) -> bool {
        let largest = self.max_storage_bytes();
        let sizes = (0..bytes.div_ceil(largest)).map(|i| largest.min(bytes - i * largest));
        let pieces = sizes.map(|size| allocate(self, "trial", size.next_multiple_of(16), BufferUsages::STORAGE, false));
        !self.memory.is_beyond(bytes) && pieces.collect::<Result<Vec<_>, _>>().is_ok()
    }
}

/// A wgpu buffer, maybe mapped. An adapter without the memory for it refuses at once, and goes on working.
pub(super) fn allocate(gpu: &Gpu, label: &str, size: u64, usage: BufferUsages, mapped: bool) -> Result<wgpu::Buffer, GpuError> {
    if gpu.memory.is_beyond(size) {
        return Err(GpuError::OutOfMemory(label.into()));
    }
    let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
    let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: mapped };
    let raw = gpu.device.create_buffer(&descriptor);
    let refused = pollster::block_on(scope.pop());
    refused.map_or(Ok(raw), |error| Err(GpuError::OutOfMemory(format!("{label}: {error}"))))
}

impl Drop for GpuBuffer {
    fn drop(&mut self) {
        if let Some(memory) = &self.memory {
            memory.remove(self.size);
            // Not when the last bind group over it goes: kernels keep theirs until they need another.
            self.raw.destroy();
        }
    }
}
