//! The GPU's part of density control: a verdict on each Gaussian, and what is remembered of it.

use super::scores::OverScores;
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, Part, workgroups};
use crate::render::layout::{BlendForm, DensitySetup};
use crate::render::{GpuCloud, shaders};

/// The passes over a map and its scores.
#[derive(Debug)]
pub struct DensityPasses {
    verdicts: Kernel,
    history: Kernel,
    setup: GpuBuffer,
    count: u32,
    /// `[capacity]` u32 of `shaders/density_verdicts.wgsl`.
    words: GpuBuffer,
    capacity: u32,
}

/// [`DensityPasses`] over one map.
pub struct Verdicts<'a> {
    passes: &'a DensityPasses,
    gpu: &'a Gpu,
    cloud: &'a GpuCloud,
}

impl DensityPasses {
    /// Compiles the passes.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(BlendForm::default()));
        Ok(Self {
            verdicts: kernel(&shaders::DENSITY_VERDICTS),
            history: kernel(&shaders::DENSITY_HISTORY),
            setup: GpuBuffer::computed_uniform(gpu, "density setup", size_of::<DensitySetup>() as u64)?,
            count: 0,
            words: GpuBuffer::storage(gpu, "verdicts", 16)?,
            capacity: 0,
        })
    }

    /// Takes in the rules for a map, before the next submission.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn prepare(&mut self, gpu: &Gpu, setup: &DensitySetup) -> Result<(), GpuError> {
        self.reserve(gpu, setup.capacity)?;
        self.setup.write(gpu, 0, std::slice::from_ref(setup));
        self.count = setup.count;
        Ok(())
    }

    /// Room for the verdicts on a map of such a capacity.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit.
    pub fn reserve(&mut self, gpu: &Gpu, capacity: u32) -> Result<(), GpuError> {
        if capacity != self.capacity {
            self.words = GpuBuffer::storage(gpu, "verdicts", u64::from(capacity) * 4)?;
            self.capacity = capacity;
        }
        Ok(())
    }

    /// The verdicts on a map by the rules that were prepared for it, `[N]` u32: `VERDICT_*`, `SEEN`, `FAINT`, and the upper bits of a score.
    pub fn verdicts<'a>(&'a self, gpu: &'a Gpu, cloud: &'a GpuCloud) -> Verdicts<'a> {
        Verdicts { passes: self, gpu, cloud }
    }

    /// Adds `scores` to the histories of the map that the rules were prepared for: once for all views since they were cleared.
    pub fn remember(&self, gpu: &Gpu, cloud: &GpuCloud, scores: &GpuBuffer) {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let bindings = [(0, &self.setup), (1, scores), (2, cloud.histories())];
        self.history.dispatch(gpu, &mut encoder.begin_compute_pass(&Default::default()), &bindings, self.size());
        gpu.submit(encoder);
    }

    fn size(&self) -> [u32; 3] {
        workgroups(self.count.div_ceil(256))
    }
}

impl OverScores for Verdicts<'_> {
    fn encode(&self, pass: &mut wgpu::ComputePass<'_>, scores: &GpuBuffer) {
        let Self { passes, gpu, cloud } = self;
        let bindings = [(0, &passes.setup), (1, scores), (2, cloud.averages()), (3, cloud.histories()), (4, &passes.words)];
        passes.verdicts.dispatch(gpu, pass, &bindings, passes.size());
    }

    fn part(&self) -> Part<'_> {
        self.passes.words.part::<u32>(0, self.passes.count as usize)
    }
}
