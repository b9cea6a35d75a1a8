//! Encodes the forward pass: project, compact, depth sort, tile lists, tile sort, blend.
//!
//! Nothing is read back in between: counts stay on the GPU and later dispatches take their size from them. When the intersections outgrow
//! their buffers, the GPU renders nothing and says how many there are; the caller grows the buffers and repeats the step.

use std::sync::Arc;

use bytemuck::Zeroable;

use super::cloud::GpuCloud;
use super::layout::{BlendForm, COUNTERS, Counter, INTERSECTION_COUNTER, ScanSetup, TileListsSetup, VISIBLE_COUNTER, View};
use super::shaders;
use super::sort::{Scan, ScanJob, Sort, SortJob};
use super::workspace::{Capacities, Workspace};
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel, workgroups};
use crate::splat::{Exposure, ViewCamera};

/// Depth keys are whole f32.
const DEPTH_KEY_BITS: u32 = 32;

/// A rendered view on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendered {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `[H, W]` colour over the background, and Σ w z in metres.
    pub color_depth: Vec<[f32; 4]>,
    /// `[H, W]` share of light that reaches what lies behind the map; alpha is one minus it.
    pub transmittance: Vec<f32>,
}

impl Rendered {
    /// Share of the pixel `i` that the map covers.
    pub fn alpha(&self, i: usize) -> f32 {
        1.0 - self.transmittance[i]
    }

    /// Becomes what a camera of this exposure records of it.
    pub fn expose(&mut self, exposure: &Exposure) {
        let [r, g, b] = exposure.gains().to_array();
        self.color_depth.iter_mut().for_each(|p| *p = [p[0] * r, p[1] * g, p[2] * b, p[3]]);
    }

    /// Expected depth of what was blended at pixel `i`, metres; 0 where nothing was.
    pub fn expected_depth(&self, i: usize) -> f32 {
        if self.alpha(i) > 0.0 { self.color_depth[i][3] / self.alpha(i) } else { 0.0 }
    }
}

/// Counts of a rendered view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewCounts {
    /// Gaussians that reach the image.
    pub visible: u32,
    /// Intersections of Gaussians with tiles.
    pub intersections: u32,
}

#[derive(Debug)]
struct Kernels {
    project_forward: Kernel,
    compact_visible: Kernel,
    tile_lists: Kernel,
    tile_ranges: Kernel,
    order_tiles: Kernel,
    rasterize_forward: Kernel,
    scan: Scan,
    sort: Sort,
}

/// The forward pass with its scratch buffers; the optimiser reads these for the backward pass.
#[derive(Debug)]
pub struct Rasterizer {
    gpu: Arc<Gpu>,
    form: BlendForm,
    kernels: Kernels,
    count_mode: GpuBuffer,
    emit_mode: GpuBuffer,
    // Written anew for each view. A write takes effect before the next submission, so one view at a time may be prepared.
    view: GpuBuffer,
    visible_scan: GpuBuffer,
    intersection_scan: GpuBuffer,
    pub(crate) workspace: Workspace,
}

/// A view prepared for encoding, and where its sorted intersections will lie.
#[derive(Clone, Copy, Debug)]
pub struct PreparedView {
    /// Constants of the view, as uploaded.
    pub view: View,
    /// Which of `workspace.slots` holds the sorted intersections.
    pub sorted: usize,
}

impl Rasterizer {
    /// With the form of the blending passes that suits the adapter.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        let form = BlendForm::of(&gpu);
        Self::with_form(gpu, form)
    }

    /// With a given form of the blending passes.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn with_form(gpu: Arc<Gpu>, form: BlendForm) -> Result<Self, GpuError> {
        let kernel = |source: &shaders::ShaderSource| Kernel::new(&gpu, source.name, "main", &source.text(form));
        let kernels = Kernels {
            project_forward: kernel(&shaders::PROJECT_FORWARD),
            compact_visible: kernel(&shaders::COMPACT_VISIBLE),
            tile_lists: kernel(&shaders::TILE_LISTS),
            tile_ranges: kernel(&shaders::TILE_RANGES),
            order_tiles: kernel(&shaders::ORDER_TILES),
            rasterize_forward: kernel(&shaders::RASTERIZE_FORWARD),
            scan: Scan::new(&gpu),
            sort: Sort::new(&gpu)?,
        };
        gpu.check()?;
        Ok(Self {
            form,
            kernels,
            count_mode: GpuBuffer::uniform(&gpu, "count mode", &TileListsSetup { emit: 0, pad: [0; 3] })?,
            emit_mode: GpuBuffer::uniform(&gpu, "emit mode", &TileListsSetup { emit: 1, pad: [0; 3] })?,
            view: GpuBuffer::uniform(&gpu, "view", &View::zeroed())?,
            visible_scan: GpuBuffer::uniform(&gpu, "visible scan", &ScanSetup::zeroed())?,
            intersection_scan: GpuBuffer::uniform(&gpu, "intersection scan", &ScanSetup::zeroed())?,
            workspace: Workspace::new(&gpu)?,
            gpu,
        })
    }

    /// The device that it runs on.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The uniform of the prepared view.
    pub fn view(&self) -> &GpuBuffer {
        &self.view
    }

    /// The form of the blending passes.
    pub fn form(&self) -> BlendForm {
        self.form
    }

    /// Capacities of the scratch buffers.
    pub fn capacities(&self) -> Capacities {
        self.workspace.capacities()
    }

    /// Reserves scratch buffers of the given capacities.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn reserve(&mut self, capacities: Capacities) -> Result<(), GpuError> {
        self.workspace.reserve(&self.gpu, capacities)
    }

    /// Reserves buffers for the view and uploads it; it must be submitted before another is prepared.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn prepare(&mut self, cloud: &GpuCloud, camera: &ViewCamera, background: [f32; 3]) -> Result<PreparedView, GpuError> {
        let mut view = View::new(camera, background);
        self.workspace.reserve_gaussians(&self.gpu, cloud.capacity())?;
        self.workspace.reserve_image(&self.gpu, view.pixels(), view.tiles())?;
        view.gaussian_count = cloud.len() as u32;
        // All per-Gaussian buffers of the workspace are at least as long as the map's planes, whose stride both share.
        view.capacity = cloud.capacity() as u32;
        view.sh_degree = u32::from(cloud.sh_degree().get());
        view.intersection_capacity = self.workspace.intersection_capacity as u32;
        let tile_bits = u32::BITS - view.tiles().leading_zeros();
        self.view.write(&self.gpu, 0, &[view]);
        let visible = ScanSetup::known(view.gaussian_count, VISIBLE_COUNTER, view.gaussian_count);
        self.visible_scan.write(&self.gpu, 0, &[visible]);
        self.intersection_scan.write(
            &self.gpu,
            0,
            &[ScanSetup::counted(VISIBLE_COUNTER, INTERSECTION_COUNTER, view.intersection_capacity)],
        );
        Ok(PreparedView { view, sorted: (tile_bits.div_ceil(8) % 2) as usize })
    }

    /// Encodes what must precede the pass of [`Self::encode_forward`].
    pub fn encode_clear(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.clear_buffer(self.workspace.ranges.raw(), 0, None);
        encoder.clear_buffer(self.workspace.unsampled.raw(), 0, None);
        encoder.clear_buffer(self.workspace.counters.raw(), 0, None);
    }

    /// Encodes the forward pass over a map's parameters or their averages.
    pub fn encode_forward(&self, pass: &mut wgpu::ComputePass<'_>, parameters: &GpuBuffer, prepared: &PreparedView) {
        let (gpu, ws, k) = (&*self.gpu, &self.workspace, &self.kernels);
        let (view, uniform) = (&prepared.view, &self.view);
        let count = view.gaussian_count;
        let per_gaussian = workgroups(count.div_ceil(256));
        let project = [(0, uniform), (1, parameters), (2, &ws.projected), (3, &ws.visible), (4, &ws.unsampled)];
        k.project_forward.dispatch(gpu, pass, &project, per_gaussian);
        let job = ScanJob { setup: &self.visible_scan, values: &ws.visible, prefix: &ws.prefix, bound: count };
        k.scan.encode(gpu, pass, ws, &job);
        let compact = [
            (0, uniform),
            (1, &ws.visible),
            (2, &ws.prefix),
            (3, &ws.projected),
            (4, &ws.depth_keys[0]),
            (5, &ws.order[0]),
            (6, &ws.intersection_counts),
        ];
        k.compact_visible.dispatch(gpu, pass, &compact, per_gaussian);
        let by_depth = SortJob { keys: &ws.depth_keys, values: &ws.order, counter: VISIBLE_COUNTER, bits: DEPTH_KEY_BITS };
        k.sort.encode(gpu, pass, ws, &by_depth);
        self.encode_tiles(pass, prepared);
        let bindings = [
            (0, uniform),
            (1, &ws.ranges),
            (2, &ws.slots[prepared.sorted]),
            (3, &ws.slot_gaussians),
            (4, &ws.projected),
            (5, &ws.color_depth),
            (6, &ws.state),
        ];
        k.rasterize_forward.dispatch(gpu, pass, &bindings, self.form.workgroups(view.tiles()));
    }

    /// Tile lists: count, offsets, emit, stable sort by tile, ranges, order.
    fn encode_tiles(&self, pass: &mut wgpu::ComputePass<'_>, prepared: &PreparedView) {
        let (gpu, ws, k) = (&*self.gpu, &self.workspace, &self.kernels);
        let visible = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        let lists = |mode| {
            [
                (0, &self.view),
                (1, mode),
                (2, &ws.counters),
                (3, &ws.order[0]),
                (4, &ws.projected),
                (5, &ws.intersection_counts),
                (6, &ws.intersection_offsets),
                (7, &ws.tile_keys[0]),
                (8, &ws.slots[0]),
                (9, &ws.slot_gaussians),
                (10, &ws.unsampled),
            ]
        };
        k.tile_lists.dispatch_indirect(gpu, pass, &lists(&self.count_mode), visible);
        let bound = prepared.view.gaussian_count;
        let job =
            ScanJob { setup: &self.intersection_scan, values: &ws.intersection_counts, prefix: &ws.intersection_offsets, bound };
        k.scan.encode(gpu, pass, ws, &job);
        k.tile_lists.dispatch_indirect(gpu, pass, &lists(&self.emit_mode), visible);
        let tile_bits = u32::BITS - prepared.view.tiles().leading_zeros();
        let by_tile = SortJob { keys: &ws.tile_keys, values: &ws.slots, counter: INTERSECTION_COUNTER, bits: tile_bits };
        let sorted = k.sort.encode(gpu, pass, ws, &by_tile);
        debug_assert_eq!(sorted, prepared.sorted);
        let ranges = [(0, &ws.counters), (1, &ws.tile_keys[sorted]), (2, &ws.ranges)];
        let intersections = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(INTERSECTION_COUNTER) };
        k.tile_ranges.dispatch_indirect(gpu, pass, &ranges, intersections);
        k.order_tiles.dispatch(gpu, pass, &[(0, &self.view), (1, &ws.ranges)], [1, 1, 1]);
    }

    /// Reads the counters of the last view; when its intersections did not fit, grows the buffers and returns `None`: repeat the step.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn finish(&mut self) -> Result<Option<ViewCounts>, GpuError> {
        let counters: Vec<Counter> = self.workspace.counters.read(&self.gpu, 0, COUNTERS as usize)?;
        let counts = self.counts(&counters);
        self.reserve_for(&counters)?;
        Ok(counts)
    }

    /// Counts of a view; `None` where its intersections did not fit.
    pub fn counts(&self, counters: &[Counter]) -> Option<ViewCounts> {
        let intersections = counters[INTERSECTION_COUNTER as usize];
        let fits = intersections.count == intersections.needed;
        fits.then(|| ViewCounts { visible: counters[VISIBLE_COUNTER as usize].count, intersections: intersections.count })
    }

    /// Enlarges the intersection buffers to what the counters of a view need.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn reserve_for(&mut self, counters: &[Counter]) -> Result<(), GpuError> {
        let needed = counters[INTERSECTION_COUNTER as usize].needed as usize;
        if needed > self.workspace.intersection_capacity {
            tracing::debug!(intersections = needed, "enlarging the intersection buffers");
            self.workspace.reserve_intersections(&self.gpu, needed)?;
        }
        Ok(())
    }

    /// Renders a view and reads it back.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, cloud: &GpuCloud, camera: &ViewCamera, background: [f32; 3]) -> Result<Rendered, GpuError> {
        loop {
            let prepared = self.prepare(cloud, camera, background)?;
            let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
            self.encode_clear(&mut encoder);
            self.encode_forward(&mut encoder.begin_compute_pass(&Default::default()), cloud.averages(), &prepared);
            self.gpu.queue.submit([encoder.finish()]);
            if self.finish()?.is_none() {
                continue;
            }
            let pixels = prepared.view.pixels() as usize;
            let state: Vec<[f32; 2]> = self.workspace.state.read(&self.gpu, 0, pixels)?;
            return Ok(Rendered {
                width: prepared.view.width,
                height: prepared.view.height,
                color_depth: self.workspace.color_depth.read(&self.gpu, 0, pixels)?,
                transmittance: state.iter().map(|s| s[0]).collect(),
            });
        }
    }
}
