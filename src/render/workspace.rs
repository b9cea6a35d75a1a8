//! The rasterizer's scratch buffers, grown when a view needs more.

use serde::{Deserialize, Serialize};

use super::layout::{Blending, COUNTERS, Counter, SORT_BLOCK, SORT_CHUNK};
use crate::gpu::{Gpu, GpuBuffer, GpuError};

/// Bytes of one intersection's gradient: three vec4.
const INTERSECTION_GRADIENT_BYTES: u64 = 48;

/// Bytes of a buffer whose size is not known yet.
const EMPTY_BYTES: u64 = 16;
/// Where a view has more intersections than there is room for, the buffers get room for a part in so many beyond them.
const MARGIN_DIVISOR: usize = 4;

/// Scratch that one rendered view leaves behind for its backward pass. Sizes only grow.
#[derive(Debug)]
pub(crate) struct Workspace {
    blending: Blending,
    pub(crate) counters: GpuBuffer,
    // Per Gaussian.
    pub(crate) capacity: usize,
    pub(crate) projected: GpuBuffer,
    pub(super) visible: GpuBuffer,
    /// Per workgroup of 256.
    pub(super) block_sums: GpuBuffer,
    pub(super) depth_keys: [GpuBuffer; 2],
    /// Visible Gaussians in `[0]`: in map order, or in the narrow form nearest first after the depth sort.
    pub(crate) order: [GpuBuffer; 2],
    /// Per visible Gaussian its intersections, in `order`; then per Gaussian where its slots begin and end; then the visible ones in map order.
    pub(crate) intersection_counts: GpuBuffer,
    // Per intersection.
    pub(crate) intersection_capacity: usize,
    pub(super) tile_keys: [GpuBuffer; 2],
    pub(crate) slots: [GpuBuffer; 2],
    pub(crate) slot_gaussians: GpuBuffer,
    pub(crate) intersection_gradients: GpuBuffer,
    pub(super) histogram: GpuBuffer,
    // Per image.
    pixels: u32,
    tiles: u32,
    pub(crate) ranges: GpuBuffer,
    /// The image, then the checkpoints of its tiles.
    pub(crate) color_depth: GpuBuffer,
    pub(crate) state: GpuBuffer,
}

/// Capacities of the scratch buffers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Capacities {
    gaussians: usize,
    intersections: usize,
    pixels: u32,
    tiles: u32,
}

impl Workspace {
    pub(super) fn new(gpu: &Gpu, blending: Blending) -> Result<Self, GpuError> {
        let (capacity, intersection_capacity) = (16_384, 131_072);
        let empty = |label: &str| GpuBuffer::storage(gpu, label, EMPTY_BYTES);
        let mut workspace = Self {
            blending,
            counters: GpuBuffer::storage(gpu, "counters", u64::from(COUNTERS) * std::mem::size_of::<Counter>() as u64)?,
            capacity: 0,
            projected: empty("projected")?,
            visible: empty("visible")?,
            block_sums: empty("block sums")?,
            depth_keys: [empty("depth keys")?, empty("depth keys")?],
            order: [empty("order")?, empty("order")?],
            intersection_counts: empty("intersection counts")?,
            intersection_capacity: 0,
            tile_keys: [empty("tile keys")?, empty("tile keys")?],
            slots: [empty("slots")?, empty("slots")?],
            slot_gaussians: empty("slot Gaussians")?,
            intersection_gradients: empty("intersection gradients")?,
            histogram: empty("histogram")?,
            pixels: 0,
            tiles: 0,
            ranges: empty("ranges")?,
            color_depth: empty("rendered")?,
            state: empty("rendered state")?,
        };
        workspace.reserve_gaussians(gpu, capacity)?;
        workspace.reserve_intersections(gpu, intersection_capacity)?;
        Ok(workspace)
    }

    pub(super) fn capacities(&self) -> Capacities {
        Capacities { gaussians: self.capacity, intersections: self.intersection_capacity, pixels: self.pixels, tiles: self.tiles }
    }

    /// Bytes by which a view that has a few more intersections lets the buffers grow.
    pub(super) fn growth_bytes(&self) -> u64 {
        let each = 5 * 4 + INTERSECTION_GRADIENT_BYTES;
        let grown = self.intersection_capacity / MARGIN_DIVISOR;
        grown as u64 * each + self.blending.checkpoint_bytes(grown)
    }

    /// Reserves exactly these capacities: that of intersections decides which steps overflow and are repeated.
    pub(super) fn reserve(&mut self, gpu: &Gpu, capacities: Capacities) -> Result<(), GpuError> {
        self.reserve_gaussians(gpu, capacities.gaussians)?;
        self.grow_intersections(gpu, capacities.intersections)?;
        self.reserve_image(gpu, capacities.pixels, capacities.tiles)
    }

    pub(super) fn reserve_gaussians(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        if capacity <= self.capacity {
            return Ok(());
        }
        let words = |label: &str| GpuBuffer::storage(gpu, label, capacity as u64 * 4);
        // The largest buffer goes before its successor comes. After a failure there is room for nothing, which the next view reserves.
        self.capacity = 0;
        self.projected = GpuBuffer::storage(gpu, "projected", EMPTY_BYTES)?;
        self.projected = GpuBuffer::storage(gpu, "projected", capacity as u64 * u64::from(self.blending.projected()) * 16)?;
        self.visible = words("visible")?;
        self.block_sums = GpuBuffer::storage(gpu, "block sums", (capacity as u64).div_ceil(256) * 4)?;
        self.depth_keys = [words("depth keys")?, words("depth keys")?];
        self.order = [words("order")?, words("order")?];
        self.intersection_counts = GpuBuffer::storage(gpu, "intersection counts", capacity as u64 * 16)?;
        self.capacity = capacity;
        self.reserve_histogram(gpu)
    }

    /// Reserves buffers for `needed` intersections, and a quarter more where the adapter can bind it.
    pub(super) fn reserve_intersections(&mut self, gpu: &Gpu, needed: usize) -> Result<(), GpuError> {
        if needed <= self.intersection_capacity {
            return Ok(());
        }
        let most = (gpu.max_storage_bytes() / INTERSECTION_GRADIENT_BYTES) as usize;
        self.grow_intersections(gpu, (needed + needed / MARGIN_DIVISOR).min(most).max(needed))
    }

    fn grow_intersections(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        let words = |label: &str| GpuBuffer::storage(gpu, label, capacity as u64 * 4);
        // As above.
        self.intersection_capacity = 0;
        self.intersection_gradients = GpuBuffer::storage(gpu, "intersection gradients", EMPTY_BYTES)?;
        self.tile_keys = [words("tile keys")?, words("tile keys")?];
        self.slots = [words("slots")?, words("slots")?];
        self.slot_gaussians = words("slot Gaussians")?;
        self.intersection_gradients =
            GpuBuffer::storage(gpu, "intersection gradients", capacity as u64 * INTERSECTION_GRADIENT_BYTES)?;
        self.color_depth = self.rendered(gpu, self.pixels, capacity)?;
        self.intersection_capacity = capacity;
        self.reserve_histogram(gpu)
    }

    fn reserve_histogram(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let blocks = (self.capacity.max(self.intersection_capacity) as u64).div_ceil(u64::from(SORT_BLOCK));
        self.histogram = GpuBuffer::storage(gpu, "histogram", (blocks + blocks.div_ceil(u64::from(SORT_CHUNK))) * 256 * 4)?;
        Ok(())
    }

    pub(super) fn reserve_image(&mut self, gpu: &Gpu, pixels: u32, tiles: u32) -> Result<(), GpuError> {
        if tiles > self.tiles {
            self.ranges = GpuBuffer::storage(gpu, "ranges", u64::from(tiles) * 16)?;
            self.tiles = tiles;
        }
        if pixels > self.pixels {
            self.color_depth = self.rendered(gpu, pixels, self.intersection_capacity)?;
            self.state = GpuBuffer::storage(gpu, "rendered state", u64::from(pixels) * 8)?;
            self.pixels = pixels;
        }
        Ok(())
    }

    fn rendered(&self, gpu: &Gpu, pixels: u32, intersections: usize) -> Result<GpuBuffer, GpuError> {
        let bytes = u64::from(pixels) * u64::from(self.blending.image_planes()) * 16;
        GpuBuffer::storage(gpu, "rendered", bytes + self.blending.checkpoint_bytes(intersections))
    }
}
