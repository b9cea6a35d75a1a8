//! How evenly a view's work is spread over the lanes of a GPU: counted from the buffers of a rendered view by the rules of the shaders, for subgroups of
//! 32 lanes.

use serde::Serialize;

use crate::gpu::GpuError;
use crate::render::layout::{BlendForm, TILE_HEIGHT};
use crate::render::{GpuCloud, Rasterizer, ViewCounts};

const SUBGROUP: usize = 32;
const WORKGROUP: u32 = 256;

/// Loop iterations of a stage, over all its lanes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LaneUse {
    /// Iterations with work.
    pub busy: u64,
    /// Iterations for which a subgroup held the lane.
    pub held: u64,
    /// Iterations of the longest lane, one after the other.
    pub longest: u64,
}

impl LaneUse {
    /// Busy share of the held iterations, 0 to 1.
    pub fn efficiency(&self) -> f64 {
        if self.held == 0 { 1.0 } else { self.busy as f64 / self.held as f64 }
    }

    /// Lanes that each loop on their own; a subgroup ends with its longest.
    fn add_lanes(&mut self, iterations: &[u64]) {
        for subgroup in iterations.chunks(SUBGROUP) {
            let longest = subgroup.iter().copied().max().unwrap_or(0);
            self.busy += subgroup.iter().sum::<u64>();
            self.held += longest * SUBGROUP as u64;
            self.longest = self.longest.max(longest);
        }
    }

    /// Items that a workgroup takes in turn, one a lane; returns the rounds.
    fn add_shared(&mut self, items: u32) -> u64 {
        self.busy += u64::from(items);
        self.held += u64::from(items).next_multiple_of(SUBGROUP as u64);
        u64::from(items.div_ceil(WORKGROUP))
    }
}

/// Lane use of the two stages whose work differs most from Gaussian to Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Lanes {
    /// `tile_lists_*`, counting and emitting.
    pub lists: LaneUse,
    /// The sums of a Gaussian's intersections: `sum_slots` and the loop of `project_backward`.
    pub slot_sums: LaneUse,
}

/// Counts the lanes of the view that was rendered last.
///
/// # Errors
/// [`GpuError`] if the device fails.
pub fn count_lanes(rasterizer: &Rasterizer, cloud: &GpuCloud, counts: ViewCounts, tiles_y: u32) -> Result<Lanes, GpuError> {
    let (gpu, ws, visible) = (rasterizer.gpu(), &rasterizer.workspace, counts.visible as usize);
    let order: Vec<u32> = ws.order[0].read(gpu, 0, visible)?;
    let tiles: Vec<u32> = ws.intersection_counts.read(gpu, 0, visible)?;
    let ends: Vec<u32> = ws.intersection_counts.read(gpu, cloud.capacity(), 2 * cloud.len())?;
    let in_map_order: Vec<u32> = ws.intersection_counts.read(gpu, 3 * cloud.capacity(), visible)?;
    let projected: Vec<[[f32; 4]; 3]> = ws.projected.read(gpu, 0, cloud.len())?;
    let rows: Vec<u32> = order.iter().map(|&gaussian| row_count(&projected[gaussian as usize], tiles_y)).collect();
    let slots_of = |&gaussian: &u32| [ends[2 * gaussian as usize], ends[2 * gaussian as usize + 1]];
    let slots: Vec<[u32; 2]> = in_map_order.iter().map(slots_of).collect();
    let form = rasterizer.form();
    Ok(Lanes { lists: list_lanes(form, &rows, &tiles), slot_sums: slot_lanes(form.slot_chunk(), &slots) })
}

/// Rows of tiles that the bounding box of a projected Gaussian reaches; twin of `outline_of` in `shaders/shared/tile_rows.wgsl`.
fn row_count(projected: &[[f32; 4]; 3], tiles_y: u32) -> u32 {
    let (mean, half_extent) = (projected[0][1], f16_to_f32((projected[2][3].to_bits() >> 16) as u16));
    let row = |y: f32| (y / TILE_HEIGHT as f32).floor().clamp(0.0, tiles_y as f32 - 1.0) as u32;
    row(mean + half_extent) - row(mean - half_extent) + 1
}

/// A positive half float: the extents are finite.
fn f16_to_f32(bits: u16) -> f32 {
    let (exponent, mantissa) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023));
    if exponent == 0 { mantissa * 2f32.powi(-24) } else { (1024.0 + mantissa) * 2f32.powi(exponent - 25) }
}

/// `rows` and `tiles` of each visible Gaussian, in the order of listing.
fn list_lanes(form: BlendForm, rows: &[u32], tiles: &[u32]) -> LaneUse {
    let mut lanes = LaneUse::default();
    if form == BlendForm::Narrow {
        let each = |emitted: u32| -> Vec<u64> { rows.iter().zip(tiles).map(|(r, t)| u64::from(r + t * emitted)).collect() };
        lanes.add_lanes(&each(0));
        lanes.add_lanes(&each(1));
        return lanes;
    }
    for (rows, tiles) in rows.chunks(WORKGROUP as usize).zip(tiles.chunks(WORKGROUP as usize)) {
        let all_rows: u32 = rows.iter().sum();
        // Once to count and once to emit.
        let mut rounds = lanes.add_shared(all_rows);
        lanes.add_shared(all_rows);
        // A round of rows may end within a Gaussian, whose tiles are then spread over its rows evenly.
        let per_row = f64::from(tiles.iter().sum::<u32>()) / f64::from(all_rows.max(1));
        for first in (0..all_rows).step_by(WORKGROUP as usize) {
            let tiles = (f64::from((all_rows - first).min(WORKGROUP)) * per_row).round() as u32;
            rounds += lanes.add_shared(tiles);
            lanes.add_shared(tiles);
        }
        lanes.longest = lanes.longest.max(rounds);
    }
    lanes
}

/// The slots of each visible Gaussian (first, past the last), in map order.
fn slot_lanes(chunk: u32, slots: &[[u32; 2]]) -> LaneUse {
    let mut lanes = LaneUse::default();
    let wholes = |[first, end]: &[u32; 2]| (end / chunk).saturating_sub(first.div_ceil(chunk));
    if chunk > 1 {
        let mut sums = vec![0; slots.iter().map(|[_, end]| (*end / chunk) as usize).max().unwrap_or(0)];
        for slots in slots.iter().filter(|slots| wholes(slots) > 0) {
            sums[slots[0].div_ceil(chunk) as usize..][..wholes(slots) as usize].fill(u64::from(chunk));
        }
        lanes.add_lanes(&sums);
    }
    let loads = |slots: &[u32; 2]| u64::from(slots[1].saturating_sub(slots[0]) - (chunk - 1) * wholes(slots));
    lanes.add_lanes(&slots.iter().map(loads).collect::<Vec<_>>());
    lanes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_gaussian_holds_its_neighbours_in_the_narrow_form_alone() {
        let mut slots: Vec<[u32; 2]> = (0..64).map(|i| [4 * i, 4 * i + 4]).collect();
        slots.push([256, 1256]);
        let (one_by_one, in_chunks) = (slot_lanes(1, &slots), slot_lanes(16, &slots));
        assert_eq!((one_by_one.longest, in_chunks.longest), (1000, 70));
        assert!(one_by_one.efficiency() < 0.1 && in_chunks.efficiency() > 0.3, "{one_by_one:?} {in_chunks:?}");

        let (rows, tiles): (Vec<u32>, Vec<u32>) = (0..256).map(|i| if i == 0 { (40, 1600) } else { (1, 2) }).unzip();
        let (narrow, wide) = (list_lanes(BlendForm::Narrow, &rows, &tiles), list_lanes(BlendForm::Wide, &rows, &tiles));
        assert_eq!((narrow.longest, wide.longest), (1640, 12));
        assert!(narrow.efficiency() < 0.1 && wide.efficiency() > 0.95, "{narrow:?} {wide:?}");
    }

    #[test]
    fn half_floats_are_read() {
        let read = [0x3c00, 0x4248, 0x7bff, 0x0001].map(f16_to_f32);
        assert_eq!(read, [1.0, 3.140_625, 65504.0, 2f32.powi(-24)]);
    }
}
