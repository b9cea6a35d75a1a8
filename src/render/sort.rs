//! Scan and stable radix sort over the workspace's buffers.

use super::layout::{BlendForm, Counter, SCAN_BLOCK, SORT_BLOCK, SORT_CHUNK, ScanSetup, SortSetup};
use super::shaders;
use super::workspace::Workspace;
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, workgroups};

/// `counter_in` of a scan whose length the host knows.
const NO_COUNTER: u32 = u32::MAX;
const DIGIT_BITS: u32 = 8;

/// How long a scan is.
#[derive(Clone, Copy, Debug)]
pub(super) enum ScanLength {
    Known(u32),
    /// The count of a counter, and what it cannot exceed.
    Counter(u32, u32),
}

/// What a scan reads and writes.
pub(super) struct ScanJob<'a> {
    pub values: &'a GpuBuffer,
    pub prefix: &'a GpuBuffer,
    pub length: ScanLength,
    /// Receives the total, if it fits `capacity`.
    pub counter_out: u32,
    pub capacity: u32,
}

#[derive(Debug)]
pub(super) struct Scan {
    reduce: Kernel,
    sums: Kernel,
    apply: Kernel,
}

impl Scan {
    pub fn new(gpu: &Gpu) -> Self {
        let source = shaders::SCAN.text(BlendForm::default());
        Self {
            reduce: Kernel::new(gpu, "scan_reduce", "reduce", &source),
            sums: Kernel::new(gpu, "scan_sums", "sums", &source),
            apply: Kernel::new(gpu, "scan_apply", "apply", &source),
        }
    }

    /// Exclusive prefix sums of `job.values`; the total goes to a counter.
    pub fn encode(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, ws: &Workspace, job: &ScanJob<'_>) -> Result<(), GpuError> {
        let (count, counter_in, bound) = match job.length {
            ScanLength::Known(count) => (count, NO_COUNTER, count),
            ScanLength::Counter(counter, bound) => (0, counter, bound),
        };
        let setup = ScanSetup { count, counter_in, counter_out: job.counter_out, capacity: job.capacity };
        let setup = GpuBuffer::uniform(gpu, "scan setup", &setup)?;
        let size = workgroups(bound.div_ceil(SCAN_BLOCK));
        self.reduce.dispatch(gpu, pass, &[(0, &setup), (1, job.values), (2, &ws.block_sums), (4, &ws.counters)], size);
        self.sums.dispatch(gpu, pass, &[(0, &setup), (2, &ws.block_sums), (4, &ws.counters)], [1, 1, 1]);
        let bindings = [(0, &setup), (1, job.values), (2, &ws.block_sums), (3, job.prefix), (4, &ws.counters)];
        self.apply.dispatch(gpu, pass, &bindings, size);
        Ok(())
    }
}

#[derive(Debug)]
pub(super) struct Sort {
    count_digits: Kernel,
    scan_digits: Kernel,
    scatter: Kernel,
}

impl Sort {
    pub fn new(gpu: &Gpu) -> Self {
        let source = shaders::SORT.text(BlendForm::default());
        Self {
            count_digits: Kernel::new(gpu, "sort_count_digits", "count_digits", &source),
            scan_digits: Kernel::new(gpu, "sort_scan_digits", "scan_digits", &source),
            scatter: Kernel::new(gpu, "sort_scatter", "scatter", &source),
        }
    }

    /// Sorts `counter` pairs of `keys[0]` and `values[0]` stably by their keys' low `bits`; returns which of the two buffers of each
    /// holds the result.
    pub fn encode(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass<'_>,
        ws: &Workspace,
        (keys, values): (&[GpuBuffer; 2], &[GpuBuffer; 2]),
        (counter, bits): (u32, u32),
    ) -> Result<usize, GpuError> {
        let arguments = (&ws.counters, Counter::per_block_offset(counter));
        let chunks = (keys[0].raw().size() as u32 / 4).div_ceil(SORT_BLOCK * SORT_CHUNK);
        let passes = bits.div_ceil(DIGIT_BITS);
        for digit in 0..passes {
            let (from, to) = ((digit % 2) as usize, ((digit + 1) % 2) as usize);
            let setup = GpuBuffer::uniform(gpu, "sort setup", &SortSetup { shift: digit * DIGIT_BITS, counter, pad: [0; 2] })?;
            let shared = [(0, &setup), (1, &ws.counters)];
            let count = [shared[0], shared[1], (2, &keys[from]), (4, &ws.histogram)];
            self.count_digits.dispatch_indirect(gpu, pass, &count, arguments);
            self.scan_digits.dispatch(gpu, pass, &[shared[0], shared[1], (4, &ws.histogram)], workgroups(chunks));
            let scatter = [
                shared[0],
                shared[1],
                (2, &keys[from]),
                (3, &values[from]),
                (4, &ws.histogram),
                (5, &keys[to]),
                (6, &values[to]),
            ];
            self.scatter.dispatch_indirect(gpu, pass, &scatter, arguments);
        }
        Ok((passes % 2) as usize)
    }
}
