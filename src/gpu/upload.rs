//! Uploads through staging buffers that are kept: in fresh memory each 4 kB cost the host a page fault.

use std::num::NonZeroU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use wgpu::BufferUsages;

use super::Gpu;
use super::buffer::allocate;

/// Bytes of an upload that is worth a submission of its own; smaller ones go with the next.
const SMALLEST_STAGED: u64 = 64 << 10;
/// Bytes of all staging buffers that are kept.
const MOST_KEPT: u64 = 32 << 20;

/// Staging buffers that are mapped: those whose copies are done.
#[derive(Clone, Debug, Default)]
pub(super) struct UploadStaging(Arc<Mutex<Vec<wgpu::Buffer>>>);

impl UploadStaging {
    fn mapped(&self) -> MutexGuard<'_, Vec<wgpu::Buffer>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The smallest that has room for so many bytes.
    fn take(&self, bytes: u64) -> Option<wgpu::Buffer> {
        let mut mapped = self.mapped();
        let sizes = mapped.iter().enumerate().filter(|(_, staging)| staging.size() >= bytes);
        let smallest = sizes.min_by_key(|(_, staging)| staging.size())?.0;
        Some(mapped.swap_remove(smallest))
    }

    /// Keeps it once the copies from it are done; the oldest go where there are too many.
    fn keep(&self, staging: wgpu::Buffer) {
        let (kept, mapping) = (self.clone(), staging.clone());
        mapping.map_async(wgpu::MapMode::Write, .., move |result| {
            if result.is_ok() {
                let mut mapped = kept.mapped();
                mapped.push(staging);
                while mapped.iter().map(wgpu::Buffer::size).sum::<u64>() > MOST_KEPT {
                    mapped.remove(0);
                }
            }
        });
    }
}

impl Gpu {
    /// Lets `fill` write `bytes` bytes (a multiple of 4) to a buffer from `offset` on; they are there for all later submissions.
    pub(super) fn upload(&self, to: &wgpu::Buffer, offset: u64, bytes: u64, fill: impl FnOnce(wgpu::WriteOnly<'_, [u8]>)) {
        let Some(size) = NonZeroU64::new(bytes) else { return };
        self.traffic.uploaded();
        let Some(staging) = self.staging_for(bytes) else {
            if let Some(mut view) = self.queue.write_buffer_with(to, offset, size) {
                fill(view.slice(..));
            }
            return;
        };
        if let Ok(mut view) = staging.get_mapped_range_mut(..bytes) {
            fill(view.slice(..));
        }
        staging.unmap();
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&staging, 0, to, offset, bytes);
        self.submit(encoder);
        self.upload_staging.keep(staging);
    }

    /// A mapped staging buffer with room for so many bytes, if it is to be used and can be had.
    fn staging_for(&self, bytes: u64) -> Option<wgpu::Buffer> {
        if !(SMALLEST_STAGED..=MOST_KEPT / 4).contains(&bytes) {
            return None;
        }
        self.upload_staging.take(bytes).or_else(|| {
            let usage = BufferUsages::MAP_WRITE | BufferUsages::COPY_SRC;
            allocate(self, "upload", bytes.next_power_of_two(), usage, true).ok()
        })
    }
}
