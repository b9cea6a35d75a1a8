//! Encodes the forward pass: project, compact, list and sort, blend. The wide form lists intersections by tile and sorts each list; the narrow
//! one sorts Gaussians by depth, lists their tiles, and sorts these.
//!
//! Nothing is read back in between: counts stay on the GPU and later dispatches take their size from them. When the intersections outgrow
//! their buffers, the GPU renders nothing and says how many there are; the caller grows the buffers and repeats the step.

use std::sync::Arc;

use super::cloud::GpuCloud;
use super::layout::{BlendForm, Blending, COUNTERS, Counter, INTERSECTION_COUNTER, TileListsSetup, VISIBLE_COUNTER, View};
use super::ordering::Ordering;
use super::rendered::Rendered;
use super::shaders;
use super::workspace::{Capacities, Workspace};
use crate::gpu::{Gpu, GpuBuffer, GpuError, IndirectSize, Kernel, UniformCell, Uniforms, workgroups};
use crate::splat::ViewCamera;
use crate::splat::model::Surface;

/// Sort keys and values twice, and the Gaussian.
const INTERSECTION_BYTES: u64 = 20;

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
    rasterize_forward: Kernel,
    scan_blocks: Kernel,
    ordering: Ordering,
}

/// The forward pass with its scratch buffers; the optimiser reads these for the backward pass.
#[derive(Debug)]
pub struct Rasterizer {
    gpu: Arc<Gpu>,
    blending: Blending,
    kernels: Kernels,
    /// Views of more intersections are refused.
    most_intersections: usize,
    count_mode: GpuBuffer,
    emit_mode: GpuBuffer,
    /// Those of the views and whatever else follows them in the same submission.
    pub(crate) uniforms: Uniforms,
    pub(crate) workspace: Workspace,
}

/// A view prepared for encoding, and where its sorted intersections will lie.
#[derive(Clone, Copy, Debug)]
pub struct PreparedView {
    /// Constants of the view.
    pub view: View,
    /// Their place among the uniforms.
    pub uniform: UniformCell,
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
        Self::with_blending(gpu, form)
    }

    /// Of this surface, with the form of the blending passes that suits the adapter.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn of_surface(gpu: Arc<Gpu>, surface: Surface) -> Result<Self, GpuError> {
        let blending = Blending::of(&gpu, surface);
        Self::with_blending(gpu, blending)
    }

    /// With given blending passes.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn with_blending(gpu: Arc<Gpu>, blending: impl Into<Blending>) -> Result<Self, GpuError> {
        let blending = blending.into();
        let form = blending.form;
        let kernel = |source: &shaders::ShaderSource| Kernel::new(&gpu, source.name, "main", &source.text(blending));
        let kernels = Kernels {
            project_forward: kernel(&shaders::PROJECT_FORWARD),
            compact_visible: kernel(&shaders::COMPACT_VISIBLE),
            tile_lists: kernel(match form {
                BlendForm::Wide => &shaders::TILE_LISTS_WIDE,
                BlendForm::Narrow => &shaders::TILE_LISTS_NARROW,
            }),
            rasterize_forward: kernel(match form {
                BlendForm::Wide => &shaders::RASTERIZE_FORWARD_WIDE,
                BlendForm::Narrow => &shaders::RASTERIZE_FORWARD_NARROW,
            }),
            scan_blocks: kernel(&shaders::SCAN_BLOCKS),
            ordering: Ordering::new(&gpu, blending)?,
        };
        gpu.check()?;
        Ok(Self {
            blending,
            kernels,
            most_intersections: usize::MAX,
            count_mode: GpuBuffer::uniform(&gpu, "count mode", &TileListsSetup { emit: 0, pad: [0; 3] })?,
            emit_mode: GpuBuffer::uniform(&gpu, "emit mode", &TileListsSetup { emit: 1, pad: [0; 3] })?,
            uniforms: Uniforms::new(&gpu)?,
            workspace: Workspace::new(&gpu, blending)?,
            gpu,
        })
    }

    /// Refuses views of more intersections than this, instead of growing for them.
    pub fn with_most_intersections(self, most: usize) -> Self {
        Self { most_intersections: most, ..self }
    }

    /// The device that it runs on.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The uniform of a prepared view.
    pub fn view(&self, prepared: &PreparedView) -> &GpuBuffer {
        self.uniforms.of(prepared.uniform)
    }

    /// The form of the blending passes.
    pub fn form(&self) -> BlendForm {
        self.blending.form
    }

    /// What the blending passes are compiled for.
    pub fn blending(&self) -> Blending {
        self.blending
    }

    /// Capacities of the scratch buffers.
    pub fn capacities(&self) -> Capacities {
        self.workspace.capacities()
    }

    /// Bytes by which the scratch buffers grow for a view that has a few more intersections than they have room for.
    pub fn growth_bytes(&self) -> u64 {
        self.workspace.growth_bytes()
    }

    /// Reserves scratch buffers of the given capacities.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn reserve(&mut self, capacities: Capacities) -> Result<(), GpuError> {
        self.workspace.reserve(&self.gpu, capacities)
    }

    /// Reserves buffers for the view and adds it to the uniforms, which must be uploaded before the submission. All views of a submission
    /// have one size: buffers that grow are replaced.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn prepare(&mut self, cloud: &GpuCloud, camera: &ViewCamera, background: [f32; 3]) -> Result<PreparedView, GpuError> {
        self.prepare_view(cloud, View::new(camera, background))
    }

    /// The same for the constants of a view.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn prepare_view(&mut self, cloud: &GpuCloud, mut view: View) -> Result<PreparedView, GpuError> {
        self.workspace.reserve_gaussians(&self.gpu, cloud.capacity())?;
        self.workspace.reserve_image(&self.gpu, view.pixels(), view.tiles())?;
        view.gaussian_count = cloud.len() as u32;
        // All per-Gaussian buffers of the workspace are at least as long as the map's planes, whose stride both share.
        view.capacity = cloud.capacity() as u32;
        view.sh_degree = u32::from(cloud.sh_degree().get());
        view.antialiased = f32::from(u8::from(cloud.is_antialiased()));
        view.intersection_capacity = self.workspace.intersection_capacity as u32;
        let uniform = self.uniforms.put(&view);
        Ok(PreparedView { view, uniform, sorted: self.sorted(view.tiles()) })
    }

    /// Which of `workspace.slots` holds the sorted intersections of a view of so many tiles.
    pub(crate) fn sorted(&self, tiles: u32) -> usize {
        self.kernels.ordering.sorted(tiles)
    }

    /// What all passes over the sorted tile lists bind.
    fn lists(&self, prepared: &PreparedView) -> [(u32, &GpuBuffer); 7] {
        let ws = &self.workspace;
        [
            (0, self.view(prepared)),
            (1, &ws.ranges),
            (2, &ws.slots[prepared.sorted]),
            (3, self.kernels.ordering.gaussians(ws)),
            (4, &ws.projected),
            (5, &ws.color_depth),
            (6, &ws.state),
        ]
    }

    /// Encodes a pass over the sorted tile lists after the forward pass: the wide form takes them in buckets, the narrow one tile by tile.
    pub(crate) fn encode_over_lists(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        prepared: &PreparedView,
        kernel: &Kernel,
        bindings: &[(u32, &GpuBuffer)],
    ) {
        let bindings: Vec<_> = self.lists(prepared).into_iter().chain(bindings.iter().copied()).collect();
        match self.form() {
            BlendForm::Wide => {
                let offset = Counter::per_bucket_offset(INTERSECTION_COUNTER);
                kernel.dispatch_indirect(&self.gpu, pass, &bindings, IndirectSize { buffer: &self.workspace.counters, offset });
            }
            BlendForm::Narrow => kernel.dispatch(&self.gpu, pass, &bindings, self.form().workgroups(prepared.view.tiles())),
        }
    }

    /// Encodes the forward pass over a map's parameters or their averages.
    pub fn encode_forward(&self, pass: &mut wgpu::ComputePass<'_>, parameters: &GpuBuffer, prepared: &PreparedView) {
        let (gpu, ws, k) = (&*self.gpu, &self.workspace, &self.kernels);
        let (view, uniform) = (&prepared.view, self.view(prepared));
        let per_gaussian = workgroups(view.gaussian_count.div_ceil(256).max(1));
        let project = [(0, uniform), (1, parameters), (2, &ws.projected), (3, &ws.visible), (4, &ws.block_sums)];
        k.project_forward.dispatch(gpu, pass, &project, per_gaussian);
        let compact = [
            (0, uniform),
            (1, &ws.visible),
            (2, &ws.block_sums),
            (3, &ws.projected),
            (4, &ws.depth_keys[0]),
            (5, &ws.order[0]),
            (6, &ws.intersection_counts),
            (7, &ws.counters),
            (8, &ws.ranges),
        ];
        k.compact_visible.dispatch(gpu, pass, &compact, per_gaussian);
        k.ordering.encode_before_lists(gpu, pass, ws);
        self.encode_tiles(pass, prepared);
        // The wide form needs no slots yet.
        let lists = self.lists(prepared).into_iter().filter(|(binding, _)| *binding != 2 || self.form() == BlendForm::Narrow);
        k.rasterize_forward.dispatch(gpu, pass, &lists.collect::<Vec<_>>(), self.form().workgroups(view.tiles()));
    }

    /// Tile lists: count, offsets, emit; then each sorted by depth, or all by tile.
    fn encode_tiles(&self, pass: &mut wgpu::ComputePass<'_>, prepared: &PreparedView) {
        let (gpu, ws, k) = (&*self.gpu, &self.workspace, &self.kernels);
        let (view, tiles) = (self.view(prepared), prepared.view.tiles());
        let visible = IndirectSize { buffer: &ws.counters, offset: Counter::per_element_offset(VISIBLE_COUNTER) };
        let lists = |mode| {
            [
                (0, view),
                (1, mode),
                (2, &ws.counters),
                (3, &ws.order[0]),
                (4, &ws.projected),
                (5, &ws.intersection_counts),
                (6, &ws.block_sums),
                (7, k.ordering.listed(ws)),
                (8, &ws.slots[0]),
                (9, &ws.slot_gaussians),
            ]
        };
        k.tile_lists.dispatch_indirect(gpu, pass, &lists(&self.count_mode), visible);
        let scan = [(0, view), (1, &ws.block_sums), (2, &ws.counters), (3, &ws.ranges)];
        k.scan_blocks.dispatch(gpu, pass, &scan, [k.ordering.scan_groups(), 1, 1]);
        k.tile_lists.dispatch_indirect(gpu, pass, &lists(&self.emit_mode), visible);
        k.ordering.encode_after_lists(gpu, pass, ws, (view, tiles));
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
        if needed > self.most_intersections {
            let bytes = |count: usize| count as u64 * INTERSECTION_BYTES;
            let label = "intersections of the view".into();
            return Err(GpuError::TooLarge { label, needed: bytes(needed), limit: bytes(self.most_intersections) });
        }
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
            self.uniforms.begin();
            let prepared = self.prepare(cloud, camera, background)?;
            let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
            self.encode_forward(&mut encoder.begin_compute_pass(&Default::default()), cloud.averages(), &prepared);
            self.uniforms.upload(&self.gpu);
            let (ws, pixels) = (&self.workspace, prepared.view.pixels() as usize);
            let planes = pixels * self.blending.image_planes() as usize;
            let parts = [
                ws.counters.part::<Counter>(0, COUNTERS as usize),
                ws.color_depth.part::<[f32; 4]>(0, planes),
                ws.state.part::<[u32; 2]>(0, pixels),
            ];
            let read = self.gpu.read(Some(encoder), &parts)?;
            let counters: Vec<Counter> = read.part(0);
            let (mut color_depth, state) = (read.part::<[f32; 4]>(1), read.part::<[u32; 2]>(2));
            drop(read);
            if self.counts(&counters).is_none() {
                self.reserve_for(&counters)?;
                continue;
            }
            return Ok(Rendered {
                width: prepared.view.width,
                height: prepared.view.height,
                surface: color_depth.split_off(pixels),
                color_depth,
                transmittance: state.iter().map(|s| f32::from_bits(s[0])).collect(),
            });
        }
    }
}
