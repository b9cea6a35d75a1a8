// Lists tiles (see `shared/tile_rows`) in the form that suits narrow SIMD units: one invocation a Gaussian.

// [intersections] tile of each, before the tile sort.
@group(0) @binding(7) var<storage, read_write> tile_keys: array<u32>;

var<workgroup> found_here: atomic<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let rank = block * 256u + local;
    let is_there = rank < counters[VISIBLE_COUNTER].count;
    if local == 0u {
        atomicStore(&found_here, 0u);
    }
    workgroupBarrier();
    if setup.emit == 0u {
        if is_there {
            let found = list(order[rank], false, 0u);
            intersection_counts[rank] = found;
            atomicAdd(&found_here, found);
        }
        workgroupBarrier();
        if is_there && local == 0u {
            block_sums[block] = atomicLoad(&found_here);
        }
        return;
    }
    let found = select(0u, intersection_counts[rank], is_there);
    let slot = block_sums[block] + exclusive_sum(local, found);
    if is_there && counters[INTERSECTION_COUNTER].count > 0u {
        let gaussian = order[rank];
        intersection_counts[view.capacity + 2u * gaussian] = slot;
        intersection_counts[view.capacity + 2u * gaussian + 1u] = slot + list(gaussian, true, slot);
    }
}

// Counts the tiles of a Gaussian, or emits them from `slot` on; returns their number.
fn list(gaussian: u32, emit: bool, slot: u32) -> u32 {
    let outline = outline_of(gaussian);
    var found = 0u;
    for (var y = outline.first_row; y < outline.end_row; y++) {
        let row = row_of(outline, y);
        for (var k = 0u; emit && k < row.count; k++) {
            tile_keys[slot + found + k] = row.first + k;
            slots[slot + found + k] = slot + found + k;
            slot_gaussians[slot + found + k] = gaussian;
        }
        found += row.count;
    }
    return found;
}
