//! Stable radix sort over the workspace's buffers.

use super::layout::{BlendForm, COUNTERS, Counter, SORT_BLOCK, SORT_CHUNK, SortSetup};
use super::shaders;
use super::workspace::Workspace;
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel, workgroups};

const DIGIT_BITS: u32 = 8;

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
        let chunks = (keys[0].size() as u32 / 4).div_ceil(SORT_BLOCK * SORT_CHUNK);
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
        Self::result_of(bits)
    }

    /// Which of the two buffers holds the result of a sort by so many bits.
    pub fn result_of(bits: u32) -> usize {
        (bits.div_ceil(DIGIT_BITS) % 2) as usize
    }
}
