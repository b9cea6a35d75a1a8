//! What brings a view's intersections into the order of blending: by tile, and within it by depth.

use super::layout::{BlendForm, Blending, INTERSECTION_COUNTER, VISIBLE_COUNTER};
use super::shaders;
use super::sort::{Sort, SortJob};
use super::workspace::Workspace;
use crate::gpu::{Gpu, GpuBuffer, GpuError, Kernel, workgroups};

/// See [`depth_key`](crate::splat::model::depth_key).
const DEPTH_KEY_BITS: u32 = 16;

#[derive(Debug)]
pub(super) enum Ordering {
    /// Of the wide form: intersections are listed by tile, and each list is sorted. Few passes, whose latency is what small views cost on a GPU.
    Lists(Kernel),
    /// Of the narrow form.
    Radix(Box<Radix>),
}

/// Gaussians are sorted by depth; their tiles, listed in that order, are sorted stably.
#[derive(Debug)]
pub(super) struct Radix {
    sort: Sort,
    tile_ranges: Kernel,
    order_tiles: Kernel,
}

impl Ordering {
    pub fn new(gpu: &Gpu, blending: Blending) -> Result<Self, GpuError> {
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(blending));
        Ok(match blending.form {
            BlendForm::Wide => Self::Lists(kernel(&shaders::SORT_TILES)),
            BlendForm::Narrow => Self::Radix(Box::new(Radix {
                sort: Sort::new(gpu)?,
                tile_ranges: kernel(&shaders::TILE_RANGES),
                order_tiles: kernel(&shaders::ORDER_TILES),
            })),
        })
    }

    /// Which of `workspace.slots` holds the result for an image of so many tiles.
    pub fn sorted(&self, tiles: u32) -> usize {
        match self {
            Self::Lists(_) => 0,
            Self::Radix(_) => Sort::result_of(tile_bits(tiles)),
        }
    }

    /// Workgroups of `scan_blocks`: the second turns the lengths of lists into their places.
    pub fn scan_groups(&self) -> u32 {
        match self {
            Self::Lists(_) => 2,
            Self::Radix(_) => 1,
        }
    }

    /// Where `tile_lists_*` says which tile an intersection is of.
    pub fn listed<'a>(&self, ws: &'a Workspace) -> &'a GpuBuffer {
        match self {
            Self::Lists(_) => &ws.ranges,
            Self::Radix(_) => &ws.tile_keys[0],
        }
    }

    /// The Gaussians that the blending passes read: of each sorted intersection, or of each slot.
    pub fn gaussians<'a>(&self, ws: &'a Workspace) -> &'a GpuBuffer {
        match self {
            Self::Lists(_) => &ws.slots[1],
            Self::Radix(_) => &ws.slot_gaussians,
        }
    }

    /// Encodes what precedes the lists.
    pub fn encode_before_lists(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass<'_>, ws: &Workspace) {
        if let Self::Radix(radix) = self {
            let by_depth = SortJob { keys: &ws.depth_keys, values: &ws.order, counter: VISIBLE_COUNTER, bits: DEPTH_KEY_BITS };
            radix.sort.encode(gpu, pass, ws, &by_depth);
        }
    }

    /// Encodes what follows them, for the `view` of so many tiles.
    pub fn encode_after_lists(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass<'_>,
        ws: &Workspace,
        (view, tiles): (&GpuBuffer, u32),
    ) {
        match self {
            Self::Lists(sort_tiles) => {
                let bindings = [
                    (0, view),
                    (1, &ws.ranges),
                    (2, &ws.slot_gaussians),
                    (3, &ws.projected),
                    (4, &ws.slots[0]),
                    (5, &ws.tile_keys[0]),
                    (6, &ws.slots[1]),
                ];
                sort_tiles.dispatch(gpu, pass, &bindings, workgroups(tiles));
            }
            Self::Radix(radix) => {
                let Radix { sort, tile_ranges, order_tiles } = &**radix;
                let by_tile =
                    SortJob { keys: &ws.tile_keys, values: &ws.slots, counter: INTERSECTION_COUNTER, bits: tile_bits(tiles) };
                let sorted = sort.encode(gpu, pass, ws, &by_tile);
                let ranges = [(0, view), (1, &ws.counters), (2, &ws.tile_keys[sorted]), (3, &ws.ranges)];
                tile_ranges.dispatch(gpu, pass, &ranges, workgroups(tiles.div_ceil(256)));
                order_tiles.dispatch(gpu, pass, &[(0, view), (1, &ws.ranges)], [1, 1, 1]);
            }
        }
    }
}

/// Bits of the tiles' numbers.
fn tile_bits(tiles: u32) -> u32 {
    u32::BITS - tiles.leading_zeros()
}
