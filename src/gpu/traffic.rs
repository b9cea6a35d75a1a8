//! What passes between host and adapter, counted: on a GPU each of these has a latency, which no software adapter shows.

use std::sync::atomic::{AtomicU64, Ordering};

use super::{Gpu, GpuBuffer};

/// Counts since the device was opened; differences of two readings belong to what was done in between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrafficCount {
    /// Dispatches of kernels.
    pub dispatches: u64,
    /// Clearings of buffers.
    pub clears: u64,
    /// Writes to buffers from the host.
    pub uploads: u64,
    /// Submissions of command buffers.
    pub submissions: u64,
    /// Waits of the host for the adapter.
    pub waits: u64,
    /// Bytes read back.
    pub bytes_read: u64,
}

impl std::ops::Sub for TrafficCount {
    type Output = Self;

    fn sub(self, before: Self) -> Self {
        Self {
            dispatches: self.dispatches - before.dispatches,
            clears: self.clears - before.clears,
            uploads: self.uploads - before.uploads,
            submissions: self.submissions - before.submissions,
            waits: self.waits - before.waits,
            bytes_read: self.bytes_read - before.bytes_read,
        }
    }
}

#[derive(Debug, Default)]
pub(super) struct Traffic {
    dispatches: AtomicU64,
    clears: AtomicU64,
    uploads: AtomicU64,
    submissions: AtomicU64,
    waits: AtomicU64,
    bytes_read: AtomicU64,
}

fn add(count: &AtomicU64, number: u64) {
    count.fetch_add(number, Ordering::Relaxed);
}

impl Traffic {
    pub fn dispatched(&self) {
        add(&self.dispatches, 1);
    }

    pub fn cleared(&self) {
        add(&self.clears, 1);
    }

    pub fn uploaded(&self) {
        add(&self.uploads, 1);
    }

    pub fn submitted(&self) {
        add(&self.submissions, 1);
    }

    pub fn waited(&self) {
        add(&self.waits, 1);
    }

    pub fn read(&self, bytes: u64) {
        add(&self.bytes_read, bytes);
    }

    pub fn count(&self) -> TrafficCount {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        TrafficCount {
            dispatches: of(&self.dispatches),
            clears: of(&self.clears),
            uploads: of(&self.uploads),
            submissions: of(&self.submissions),
            waits: of(&self.waits),
            bytes_read: of(&self.bytes_read),
        }
    }
}

impl Gpu {
    /// Submits the commands of `encoder`.
    pub fn submit(&self, encoder: wgpu::CommandEncoder) {
        self.queue.submit([encoder.finish()]);
        self.traffic.submitted();
    }

    /// What has passed between host and adapter so far.
    pub fn traffic(&self) -> TrafficCount {
        self.traffic.count()
    }

    /// Fills so many bytes of a buffer with zeros, from `offset` on; `None`: all that follow.
    pub fn clear(&self, encoder: &mut wgpu::CommandEncoder, buffer: &GpuBuffer, offset: u64, bytes: Option<u64>) {
        encoder.clear_buffer(buffer.raw(), offset, bytes);
        self.traffic.cleared();
    }
}
