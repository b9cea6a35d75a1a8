//! Memory of the buffers: counted, bounded, and apart for work that the bound must not see.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::Gpu;
use super::traffic::Traffic;

/// Bytes in our buffers, now and at most.
#[derive(Debug)]
pub(super) struct MemoryCount {
    now: AtomicU64,
    peak: AtomicU64,
    /// The most that there may be.
    limit: AtomicU64,
}

impl Default for MemoryCount {
    fn default() -> Self {
        Self { now: AtomicU64::new(0), peak: AtomicU64::new(0), limit: AtomicU64::new(u64::MAX) }
    }
}

impl MemoryCount {
    pub(super) fn add(&self, bytes: u64) {
        let now = self.now.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.peak.fetch_max(now, Ordering::Relaxed);
    }

    pub(super) fn remove(&self, bytes: u64) {
        self.now.fetch_sub(bytes, Ordering::Relaxed);
    }

    /// Whether so many bytes more would exceed the limit.
    pub(super) fn is_beyond(&self, bytes: u64) -> bool {
        self.now.load(Ordering::Relaxed).saturating_add(bytes) > self.limit.load(Ordering::Relaxed)
    }
}

impl Gpu {
    /// The same device for work beside that of this one: its buffers are counted apart, and no bound of this one sees them.
    pub fn beside(&self) -> Arc<Self> {
        Arc::new(Self {
            device: self.device.clone(),
            queue: self.queue.clone(),
            adapter: self.adapter.clone(),
            failure: self.failure.clone(),
            memory: Arc::default(),
            traffic: Traffic::default(),
            staging: Default::default(),
            upload_staging: Default::default(),
            profiler: None,
        })
    }

    /// From now on buffers of more than `bytes` in all are refused as an adapter of so much memory would.
    pub fn limit_memory(&self, bytes: u64) {
        self.memory.limit.store(bytes, Ordering::Relaxed);
    }

    /// Bytes that our buffers hold now.
    pub fn bytes(&self) -> u64 {
        self.memory.now.load(Ordering::Relaxed)
    }

    /// The most bytes that our buffers held at any time.
    pub fn peak_bytes(&self) -> u64 {
        self.memory.peak.load(Ordering::Relaxed)
    }
}
