//! What a new keyframe's exposure and insertion need of the map's render from there: samples of its pixels, and a word for each cell.

use super::{TargetImage, Trainer};
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, workgroups};
use crate::render::layout::{
    BRIGHTNESS_MASK, BRIGHTNESS_STEP, BlendForm, COUNTERS, Counter, LACKS_CENTER, LACKS_CORNER, SurveySetup,
};
use crate::render::{GpuCloud, PreparedView, Rasterizer, shaders};
use crate::splat::ViewCamera;

/// Pixels that are sampled, at most: the median of their colours varies by a hundredth of their spread.
const MAX_SAMPLES: u32 = 1 << 13;

/// What the map lacks, by a keyframe's depth.
#[derive(Clone, Copy, Debug)]
pub struct SurveyRules<'a> {
    /// The keyframe, on the GPU.
    pub target: &'a TargetImage,
    /// Side of a cell, pixels.
    pub cell: u32,
    /// A pixel whose alpha is below this lacks map.
    pub min_alpha: f32,
    /// A pixel whose measured depth is nearer than the map's by this share of itself does, too.
    pub depth_disagreement: f32,
}

/// A sampled pixel of the render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampledPixel {
    /// Place in row-major order.
    pub pixel: usize,
    /// Linear RGB over black, at most 1.
    pub color: [f32; 3],
    /// Share of the pixel that the map covers.
    pub alpha: f32,
}

/// One cell of pixels, those at the right and lower border maybe smaller.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurveyedCell {
    /// Mean of the render's brightness, 0 to 2.
    pub brightness: f32,
    /// Whether the map lacks what its first pixel shows.
    pub lacks_corner: bool,
    /// The same of the pixel in its middle.
    pub lacks_center: bool,
}

/// A survey of the map from a camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Survey {
    /// Cells in a row.
    pub columns: u32,
    /// Of the cells row by row, two of `shaders/survey.wgsl` each; none without rules.
    words: Vec<u32>,
    /// Spread evenly over the image.
    pub samples: Vec<SampledPixel>,
}

/// The pass and its buffers.
#[derive(Debug)]
pub(super) struct SurveyPass {
    kernel: Kernel,
    cells: GpuBuffer,
    samples: GpuBuffer,
}

impl SurveyPass {
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let source = &shaders::SURVEY;
        Ok(Self {
            kernel: Kernel::new(gpu, source.name, "main", &source.text(BlendForm::default())),
            cells: GpuBuffer::storage(gpu, "surveyed cells", 16)?,
            samples: GpuBuffer::storage(gpu, "sampled pixels", u64::from(MAX_SAMPLES) * 8)?,
        })
    }

    /// Room for so many cells.
    pub fn reserve(&mut self, gpu: &Gpu, cells: u32) -> Result<(), GpuError> {
        let bytes = u64::from(cells.div_ceil(2)) * 4;
        if bytes > self.cells.size() {
            self.cells = GpuBuffer::storage(gpu, "surveyed cells", bytes)?;
        }
        Ok(())
    }

    /// Cells that there is room for.
    pub fn capacity(&self) -> u32 {
        self.cells.size() as u32 / 2
    }

    fn encode(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        rasterizer: &Rasterizer,
        setup: (&GpuBuffer, &SurveySetup),
        target: Option<&TargetImage>,
    ) {
        let ws = &rasterizer.workspace;
        // Without cells no depth is looked at.
        let depth = target.and_then(|target| target.pixels.as_ref()).map_or(&ws.counters, |pixels| &pixels.depth);
        let bindings = [(0, setup.0), (1, &ws.color_depth), (2, &ws.state), (3, depth), (4, &self.cells), (5, &self.samples)];
        let invocations = setup.1.samples.max(setup.1.cells.div_ceil(2));
        self.kernel.dispatch(rasterizer.gpu(), pass, &bindings, workgroups(invocations.div_ceil(256)));
    }
}

/// The setup for a view.
fn setup(prepared: &PreparedView, rules: Option<&SurveyRules<'_>>) -> SurveySetup {
    let (width, height, pixels) = (prepared.view.width, prepared.view.height, prepared.view.pixels());
    let cell = rules.map_or(1, |rules| rules.cell);
    let columns = width.div_ceil(cell);
    let sample_stride = spread(pixels.div_ceil(MAX_SAMPLES).max(1), width);
    SurveySetup {
        width,
        height,
        cell,
        columns,
        cells: rules.map_or(0, |_| columns * height.div_ceil(cell)),
        sample_stride,
        samples: pixels.div_ceil(sample_stride),
        min_alpha: rules.map_or(0.0, |rules| rules.min_alpha),
        depth_disagreement: rules.map_or(0.0, |rules| rules.depth_disagreement),
        pad: [0; 3],
    }
}

/// A stride of at least `stride` pixels that visits all columns alike.
fn spread(stride: u32, width: u32) -> u32 {
    let has_common_divisor = |stride: u32| {
        let (mut a, mut b) = (stride, width);
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a > 1
    };
    (stride..).find(|&stride| stride == 1 || !has_common_divisor(stride)).unwrap_or(stride)
}

impl Survey {
    /// Of so many cells in a row, for whoever has them otherwise; without samples.
    pub fn of_cells(columns: u32, cells: &[SurveyedCell]) -> Self {
        let words = cells.chunks(2).map(|pair| pair.iter().rev().fold(0, |word, cell| word << 16 | cell.bits()));
        Self { columns, words: words.collect(), samples: Vec::new() }
    }

    /// The cell at a place in the order of rows.
    pub fn cell(&self, i: usize) -> SurveyedCell {
        SurveyedCell::from_bits(self.words[i / 2] >> (16 * (i % 2)))
    }
}

impl SurveyedCell {
    fn from_bits(bits: u32) -> Self {
        Self {
            brightness: (bits & BRIGHTNESS_MASK) as f32 * BRIGHTNESS_STEP,
            lacks_corner: bits & LACKS_CORNER != 0,
            lacks_center: bits & LACKS_CENTER != 0,
        }
    }

    fn bits(&self) -> u32 {
        let brightness = ((self.brightness / BRIGHTNESS_STEP).round() as u32).min(BRIGHTNESS_MASK);
        let flag = |is_set: bool, bit: u32| if is_set { bit } else { 0 };
        brightness | flag(self.lacks_corner, LACKS_CORNER) | flag(self.lacks_center, LACKS_CENTER)
    }
}

impl Trainer {
    /// Renders the averaged map over black and surveys it, with cells where there are rules.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn survey(&mut self, cloud: &GpuCloud, camera: &ViewCamera, rules: Option<&SurveyRules<'_>>) -> Result<Survey, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        loop {
            self.rasterizer.uniforms.begin();
            let prepared = self.rasterizer.prepare(cloud, camera, [0.0; 3])?;
            let setup = setup(&prepared, rules);
            self.survey.reserve(&gpu, setup.cells)?;
            let cell = self.rasterizer.uniforms.put(&setup);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.rasterizer.encode_forward(&mut pass, cloud.averages(), &prepared);
            let target = rules.map(|rules| rules.target);
            self.survey.encode(&mut pass, &self.rasterizer, (self.rasterizer.uniforms.of(cell), &setup), target);
            drop(pass);
            self.rasterizer.uniforms.upload(&gpu);
            let parts = [
                self.rasterizer.workspace.counters.part::<Counter>(0, COUNTERS as usize),
                self.survey.cells.part::<u32>(0, setup.cells.div_ceil(2) as usize),
                self.survey.samples.part::<[u32; 2]>(0, setup.samples as usize),
            ];
            let read = gpu.read(Some(encoder), &parts)?;
            let (counters, words, samples) = (read.part::<Counter>(0), read.part::<u32>(1), read.part::<[u32; 2]>(2));
            drop(read);
            if self.rasterizer.counts(&counters).is_none() {
                self.rasterizer.reserve_for(&counters)?;
                continue;
            }
            let shares = |word: u32| [word & 0xffff, word >> 16].map(|steps| steps as f32 / f32::from(u16::MAX));
            let sample = |(i, [first, second]): (usize, [u32; 2])| {
                let ([red, green], [blue, alpha]) = (shares(first), shares(second));
                SampledPixel { pixel: i * setup.sample_stride as usize, color: [red, green, blue], alpha }
            };
            return Ok(Survey { columns: setup.columns, words, samples: samples.into_iter().enumerate().map(sample).collect() });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_visit_all_columns() {
        for (stride, width) in [(1, 640), (50, 1200), (19, 640), (7, 35), (4, 1)] {
            let found = spread(stride, width);
            assert!(found >= stride && found < stride + 20);
            let columns: std::collections::BTreeSet<u32> = (0..width).map(|i| i * found % width).collect();
            assert_eq!(columns.len(), width as usize, "{stride} {width}");
        }
    }
}
