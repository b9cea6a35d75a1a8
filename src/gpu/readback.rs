//! Reading back: parts of several buffers in one submission and one wait, through a staging buffer that is kept.

use std::ops::Range;
use std::sync::PoisonError;

use bytemuck::Pod;
use wgpu::BufferUsages;

use super::buffer::allocate;
use super::{Gpu, GpuError};

/// Larger staging buffers are given back after use, bytes.
const LARGEST_KEPT: u64 = 32 << 20;

/// A part of a buffer, see [`GpuBuffer::part`](super::GpuBuffer::part).
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    pub(super) buffer: &'a wgpu::Buffer,
    pub(super) offset: u64,
    pub(super) bytes: u64,
}

/// Parts of buffers, read back.
pub struct ReadBack<'a> {
    gpu: &'a Gpu,
    /// One of them, unless there was no memory for that.
    mapped: Vec<(wgpu::Buffer, wgpu::BufferView)>,
    /// In which of these each part lies, and its bytes there.
    places: Vec<(usize, Range<usize>)>,
}

impl ReadBack<'_> {
    /// The elements of a part, by its place in the list of parts.
    pub fn part<T: Pod>(&self, index: usize) -> Vec<T> {
        let (mapped, bytes) = &self.places[index];
        if bytes.is_empty() {
            return Vec::new();
        }
        let bytes = &self.mapped[*mapped].1[bytes.clone()];
        // Mappings are aligned in practice; nothing promises it.
        if let Ok(elements) = bytemuck::try_cast_slice(bytes) {
            return elements.to_vec();
        }
        bytes.chunks_exact(std::mem::size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
    }
}

impl Drop for ReadBack<'_> {
    fn drop(&mut self) {
        for (staging, view) in self.mapped.drain(..) {
            drop(view);
            staging.unmap();
            if staging.size() <= LARGEST_KEPT {
                self.gpu.keep_staging(staging);
            }
        }
    }
}

impl Gpu {
    /// Submits the commands of `encoder`, if any, waits for all work, and reads parts of buffers. Where there is no memory to stage all of them, they
    /// are read one after another.
    ///
    /// # Errors
    /// [`GpuError`] if not even one part can be staged or the device fails.
    pub fn read(&self, encoder: Option<wgpu::CommandEncoder>, parts: &[Part<'_>]) -> Result<ReadBack<'_>, GpuError> {
        let bytes: u64 = parts.iter().map(|part| part.bytes).sum();
        if bytes == 0 {
            encoder.into_iter().for_each(|encoder| self.submit(encoder));
            return Ok(ReadBack { gpu: self, mapped: Vec::new(), places: vec![(0, 0..0); parts.len()] });
        }
        let staging = match self.staging(bytes) {
            Err(GpuError::OutOfMemory(_)) if parts.len() > 1 => {
                let (first, second) = parts.split_at(parts.len() / 2);
                let (mut read, mut rest) = (self.read(encoder, first)?, self.read(None, second)?);
                let offset = read.mapped.len();
                read.mapped.append(&mut rest.mapped);
                read.places.extend(rest.places.drain(..).map(|(mapped, bytes)| (mapped + offset, bytes)));
                return Ok(read);
            }
            staging => staging?,
        };
        let mut encoder = encoder.unwrap_or_else(|| self.device.create_command_encoder(&Default::default()));
        let mut places = Vec::with_capacity(parts.len());
        let mut end = 0;
        for part in parts {
            if part.bytes > 0 {
                encoder.copy_buffer_to_buffer(part.buffer, part.offset, &staging, end, part.bytes);
            }
            places.push((0, end as usize..(end + part.bytes) as usize));
            end += part.bytes;
        }
        self.submit(encoder);
        staging.map_async(wgpu::MapMode::Read, ..bytes, |_| {});
        self.wait()?;
        self.traffic.read(bytes);
        let view = staging.get_mapped_range(..bytes).map_err(|e| GpuError::Failed(e.to_string()))?;
        Ok(ReadBack { gpu: self, mapped: vec![(staging, view)], places })
    }

    /// The kept staging buffer if it is large enough, or a new one.
    fn staging(&self, bytes: u64) -> Result<wgpu::Buffer, GpuError> {
        match self.take_staging().filter(|staging| staging.size() >= bytes) {
            Some(staging) => Ok(staging),
            None => allocate(self, "readback", bytes, BufferUsages::MAP_READ | BufferUsages::COPY_DST, false),
        }
    }

    fn take_staging(&self) -> Option<wgpu::Buffer> {
        self.staging.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn keep_staging(&self, staging: wgpu::Buffer) {
        *self.staging.lock().unwrap_or_else(PoisonError::into_inner) = Some(staging);
    }
}
