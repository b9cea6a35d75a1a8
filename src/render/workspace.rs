//! The rasterizer's scratch buffers, grown when a view needs more.

use serde::{Deserialize, Serialize};

use super::layout::{COUNTERS, Counter, SCAN_BLOCK, SORT_BLOCK, SORT_CHUNK};
use crate::gpu::{Gpu, GpuBuffer, GpuError};

/// Bytes of one pair's gradient: three vec4.
const PAIR_GRADIENT_BYTES: u64 = 48;
/// Bytes of the mask of tiles that a step leaves out, one bit a tile: what a uniform may hold anywhere.
const SKIPPED_TILES: u64 = 16_384;

/// Scratch that one rendered view leaves behind for its backward pass. Sizes only grow.
#[derive(Debug)]
pub struct Workspace {
    pub counters: GpuBuffer,
    // Per Gaussian.
    pub(crate) capacity: usize,
    pub projected: GpuBuffer,
    pub(super) visible: GpuBuffer,
    pub(super) prefix: GpuBuffer,
    pub(super) block_sums: GpuBuffer,
    pub(super) depth_keys: [GpuBuffer; 2],
    /// Visible Gaussians, nearest first, in `[0]` after the depth sort.
    pub(super) order: [GpuBuffer; 2],
    /// Per visible Gaussian its pairs, nearest first; then per Gaussian where its slots begin and end; then the visible ones in map order.
    pub pair_counts: GpuBuffer,
    pub(super) pair_offsets: GpuBuffer,
    // Per pair.
    pub(crate) pair_capacity: usize,
    pub(super) tile_keys: [GpuBuffer; 2],
    pub slots: [GpuBuffer; 2],
    pub slot_gaussians: GpuBuffer,
    pub pair_gradients: GpuBuffer,
    pub(super) histogram: GpuBuffer,
    // Per image.
    pixels: u32,
    tiles: u32,
    pub ranges: GpuBuffer,
    /// One bit a tile.
    pub skipped: GpuBuffer,
    pub color_depth: GpuBuffer,
    pub state: GpuBuffer,
}

/// What a workspace has room for.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Room {
    gaussians: usize,
    pairs: usize,
    pixels: u32,
    tiles: u32,
}

impl Workspace {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let (capacity, pair_capacity) = (16_384, 131_072);
        let empty = |label: &str| GpuBuffer::storage(gpu, label, 16);
        let mut workspace = Self {
            counters: GpuBuffer::storage(gpu, "counters", u64::from(COUNTERS) * std::mem::size_of::<Counter>() as u64)?,
            capacity: 0,
            projected: empty("projected")?,
            visible: empty("visible")?,
            prefix: empty("prefix")?,
            block_sums: empty("block sums")?,
            depth_keys: [empty("depth keys")?, empty("depth keys")?],
            order: [empty("order")?, empty("order")?],
            pair_counts: empty("pair counts")?,
            pair_offsets: empty("pair offsets")?,
            pair_capacity: 0,
            tile_keys: [empty("tile keys")?, empty("tile keys")?],
            slots: [empty("slots")?, empty("slots")?],
            slot_gaussians: empty("slot Gaussians")?,
            pair_gradients: empty("pair gradients")?,
            histogram: empty("histogram")?,
            pixels: 0,
            tiles: 0,
            ranges: empty("ranges")?,
            skipped: GpuBuffer::computed_uniform(gpu, "skipped tiles", SKIPPED_TILES)?,
            color_depth: empty("rendered")?,
            state: empty("rendered state")?,
        };
        workspace.reserve_gaussians(gpu, capacity)?;
        workspace.reserve_pairs(gpu, pair_capacity)?;
        Ok(workspace)
    }

    pub(super) fn room(&self) -> Room {
        Room { gaussians: self.capacity, pairs: self.pair_capacity, pixels: self.pixels, tiles: self.tiles }
    }

    /// As much room as another workspace had, exactly: by the room for pairs it depends which steps are repeated.
    pub(super) fn make(&mut self, gpu: &Gpu, room: Room) -> Result<(), GpuError> {
        self.reserve_gaussians(gpu, room.gaussians)?;
        self.grow_pairs(gpu, room.pairs)?;
        self.reserve_image(gpu, (room.pixels, room.tiles))
    }

    pub(super) fn reserve_gaussians(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        if capacity <= self.capacity {
            return Ok(());
        }
        let words = |label: &str| GpuBuffer::storage(gpu, label, capacity as u64 * 4);
        self.projected = GpuBuffer::storage(gpu, "projected", capacity as u64 * 48)?;
        self.visible = words("visible")?;
        self.prefix = words("prefix")?;
        self.block_sums = GpuBuffer::storage(gpu, "block sums", (capacity as u64).div_ceil(u64::from(SCAN_BLOCK)) * 4)?;
        self.depth_keys = [words("depth keys")?, words("depth keys")?];
        self.order = [words("order")?, words("order")?];
        self.pair_counts = GpuBuffer::storage(gpu, "pair counts", capacity as u64 * 16)?;
        self.pair_offsets = words("pair offsets")?;
        self.capacity = capacity;
        self.reserve_histogram(gpu)
    }

    /// Makes room for `needed` pairs, and a quarter more where the adapter can bind it.
    pub(super) fn reserve_pairs(&mut self, gpu: &Gpu, needed: usize) -> Result<(), GpuError> {
        if needed <= self.pair_capacity {
            return Ok(());
        }
        let most = (gpu.max_storage_bytes() / PAIR_GRADIENT_BYTES) as usize;
        self.grow_pairs(gpu, (needed + needed / 4).min(most).max(needed))
    }

    fn grow_pairs(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), GpuError> {
        let words = |label: &str| GpuBuffer::storage(gpu, label, capacity as u64 * 4);
        self.tile_keys = [words("tile keys")?, words("tile keys")?];
        self.slots = [words("slots")?, words("slots")?];
        self.slot_gaussians = words("slot Gaussians")?;
        self.pair_gradients = GpuBuffer::storage(gpu, "pair gradients", capacity as u64 * PAIR_GRADIENT_BYTES)?;
        self.pair_capacity = capacity;
        self.reserve_histogram(gpu)
    }

    fn reserve_histogram(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let blocks = (self.capacity.max(self.pair_capacity) as u64).div_ceil(u64::from(SORT_BLOCK));
        self.histogram = GpuBuffer::storage(gpu, "histogram", (blocks + blocks.div_ceil(u64::from(SORT_CHUNK))) * 256 * 4)?;
        Ok(())
    }

    pub(super) fn reserve_image(&mut self, gpu: &Gpu, (pixels, tiles): (u32, u32)) -> Result<(), GpuError> {
        if tiles > self.tiles {
            self.ranges = GpuBuffer::storage(gpu, "ranges", u64::from(tiles) * 16)?;
            self.tiles = tiles;
        }
        if pixels > self.pixels {
            self.color_depth = GpuBuffer::storage(gpu, "rendered", u64::from(pixels) * 16)?;
            self.state = GpuBuffer::storage(gpu, "rendered state", u64::from(pixels) * 8)?;
            self.pixels = pixels;
        }
        Ok(())
    }
}
