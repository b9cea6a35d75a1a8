//! Scan and stable radix sort over the workspace's buffers.

use super::layout::{BlendForm, COUNTERS, Counter, SCAN_BLOCK, SORT_BLOCK, SORT_CHUNK, ScanSetup, SortSetup};
use super::shaders;
use super::workspace::Workspace;
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel, workgroups};

/// `counter_in` of a scan whose length the host knows.
const NO_COUNTER: u32 = u32::MAX;
const DIGIT_BITS: u32 = 8;

impl ScanSetup {
    /// Scans `count` elements; the total goes to `counter_out`, if it fits `capacity`.
    pub(super) fn known(count: u32, counter_out: u32, capacity: u32) -> Self {
        Self { count, counter_in: NO_COUNTER, counter_out, capacity }
    }

    /// Scans as many elements as `counter_in` counts.
    pub(super) fn counted(counter_in: u32, counter_out: u32, capacity: u32) -> Self {
        Self { count: 0, counter_in, counter_out, capacity }
    }
}

/// A scan over given buffers, with its setup on the GPU.
pub(super) struct ScanJob<'a> {
    pub setup: &'a GpuBuffer,
    pub values: &'a GpuBuffer,
    pub prefix: &'a GpuBuffer,
    /// Upper bound of the length.
    pub bound: u32,
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
    pub fn encode(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, ws: &Workspace, job: &ScanJob<'_>) {
        let setup = job.setup;
        let size = workgroups(job.bound.div_ceil(SCAN_BLOCK));
        self.reduce.dispatch(gpu, pass, &[(0, setup), (1, job.values), (2, &ws.block_sums), (4, &ws.counters)], size);
        self.sums.dispatch(gpu, pass, &[(0, setup), (2, &ws.block_sums), (4, &ws.counters)], [1, 1, 1]);
        let bindings = [(0, setup), (1, job.values), (2, &ws.block_sums), (3, job.prefix), (4, &ws.counters)];
        self.apply.dispatch(gpu, pass, &bindings, size);
    }
}

/// Keys with their values to sort, double-buffered.
pub(super) struct SortJob<'a> {
    pub keys: &'a [GpuBuffer; 2],
    pub values: &'a [GpuBuffer; 2],
    /// Counter of the elements.
    pub counter: u32,
    /// Low bits of the keys that differ.
    pub bits: u32,
}

#[derive(Debug)]
pub(super) struct Sort {
    count_digits: Kernel,
    scan_digits: Kernel,
    scatter: Kernel,
    /// Setups of each counter, by digit.
    setups: Vec<Vec<GpuBuffer>>,
}

impl Sort {
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let setup = |counter, digit| {
            GpuBuffer::uniform(gpu, "sort setup", &SortSetup { shift: digit * DIGIT_BITS, counter, pad: [0; 2] })
        };
        let setups = |counter| (0..u32::BITS / DIGIT_BITS).map(|digit| setup(counter, digit)).collect();
        let source = shaders::SORT.text(BlendForm::default());
        Ok(Self {
            setups: (0..COUNTERS).map(setups).collect::<Result<_, _>>()?,
            count_digits: Kernel::new(gpu, "sort_count_digits", "count_digits", &source),
            scan_digits: Kernel::new(gpu, "sort_scan_digits", "scan_digits", &source),
            scatter: Kernel::new(gpu, "sort_scatter", "scatter", &source),
        })
    }

    /// Sorts `keys[0]` and `values[0]` stably by the keys' low bits; returns which of the two buffers of each holds the result.
    pub fn encode(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, ws: &Workspace, job: &SortJob<'_>) -> usize {
        let SortJob { keys, values, counter, bits } = *job;
        let arguments = IndirectSize { buffer: &ws.counters, offset: Counter::per_block_offset(counter) };
        let chunks = (keys[0].raw().size() as u32 / 4).div_ceil(SORT_BLOCK * SORT_CHUNK);
        let passes = bits.div_ceil(DIGIT_BITS);
        for digit in 0..passes {
            let (from, to) = ((digit % 2) as usize, ((digit + 1) % 2) as usize);
            let shared = [(0, &self.setups[counter as usize][digit as usize]), (1, &ws.counters)];
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
        (passes % 2) as usize
    }
}
