// Lists tiles (see `shared/tile_rows`) in the form that suits wide SIMD units: a workgroup shares out the rows of its 256 Gaussians, then the tiles of these
// rows, one an invocation. A large Gaussian keeps no lane longer than many small ones do. Gaussians come in map order; a tile's intersections go to its list as
// they come, and `sort_tiles` sorts them.

// [tiles] (first place of the list, intersections so far): where it ends, once all are listed.
@group(0) @binding(7) var<storage, read_write> ranges: array<atomic<u32>>;

// Sums over the workgroup's Gaussians up to and with each: of their rows.
var<workgroup> row_ends: array<u32, 256>;
// Tiles of each Gaussian.
var<workgroup> tiles_found: array<atomic<u32>, 256>;
// Of 256 rows: tiles up to and with each, the first tile, and the Gaussian.
var<workgroup> tile_ends: array<u32, 256>;
var<workgroup> first_tiles: array<u32, 256>;
var<workgroup> row_gaussians: array<u32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let rank = block * 256u + local;
    let is_there = rank < counters[VISIBLE_COUNTER].count;
    var rows = 0u;
    if is_there {
        let outline = outline_of(order[rank]);
        rows = outline.end_row - outline.first_row;
    }
    row_ends[local] = exclusive_sum(local, rows) + rows;
    atomicStore(&tiles_found[local], 0u);
    let all_rows = workgroupUniformLoad(&row_ends[255]);
    let has_room = counters[INTERSECTION_COUNTER].count > 0u;
    var slot = 0u;
    if setup.emit == 1u {
        let found = select(0u, intersection_counts[rank], is_there);
        slot = block_sums[block];
        let first = slot + exclusive_sum(local, found);
        if is_there && has_room {
            let gaussian = order[rank];
            intersection_counts[view.capacity + 2u * gaussian] = first;
            intersection_counts[view.capacity + 2u * gaussian + 1u] = first + found;
        }
    }
    for (var start = 0u; start < all_rows; start += 256u) {
        let item = start + local;
        var row = TileRow(0u, 0u);
        if item < all_rows {
            let member = owner_of_row(item);
            let gaussian = order[block * 256u + member];
            let outline = outline_of(gaussian);
            row = row_of(outline, outline.first_row + row_within(item, member));
            first_tiles[local] = row.first;
            row_gaussians[local] = gaussian;
            if setup.emit == 0u {
                atomicAdd(&tiles_found[member], row.count);
            }
        }
        tile_ends[local] = exclusive_sum(local, row.count) + row.count;
        let tiles_here = workgroupUniformLoad(&tile_ends[255]);
        for (var k = local; k < tiles_here; k += 256u) {
            let owner = owner_of_tile(k);
            let tile = first_tiles[owner] + k - tiles_before(owner);
            if setup.emit == 0u {
                atomicAdd(&ranges[2u * tile + 1u], 1u);
            } else if has_room {
                slots[atomicAdd(&ranges[2u * tile + 1u], 1u)] = slot + k;
                slot_gaussians[slot + k] = row_gaussians[owner];
            }
        }
        slot += tiles_here;
        workgroupBarrier();
    }
    if setup.emit == 0u && is_there {
        intersection_counts[rank] = atomicLoad(&tiles_found[local]);
        if local == 0u {
            block_sums[block] = slot;
        }
    }
}

// Of the workgroup's Gaussians, the one that the row `item` belongs to.
fn owner_of_row(item: u32) -> u32 {
    var owner = 0u;
    for (var half = 128u; half > 0u; half /= 2u) {
        owner += select(0u, half, row_ends[owner + half - 1u] <= item);
    }
    return owner;
}

// Which of its Gaussian's rows the row `item` is.
fn row_within(item: u32, owner: u32) -> u32 {
    return item - select(0u, row_ends[max(owner, 1u) - 1u], owner > 0u);
}

// Of the 256 rows, the one that the tile `k` belongs to.
fn owner_of_tile(k: u32) -> u32 {
    var owner = 0u;
    for (var half = 128u; half > 0u; half /= 2u) {
        owner += select(0u, half, tile_ends[owner + half - 1u] <= k);
    }
    return owner;
}

fn tiles_before(row: u32) -> u32 {
    return select(0u, tile_ends[max(row, 1u) - 1u], row > 0u);
}
