// Lists the tiles that each visible Gaussian really touches, nearest Gaussian first: once to count, once to emit.
//
// A tile is touched where the ellipse of alpha ≥ 1/255 reaches one of its pixel centres' hull: the minimum of the quadratic form
// over the tile's rectangle is compared with the cut. The same pipeline runs both modes, so that they cannot disagree.

struct TileListsSetup {
    // 0 counts, 1 emits.
    emit: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> setup: TileListsSetup;
@group(0) @binding(2) var<storage, read> counters: array<Counter>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;
// [visible] tiles of each Gaussian, nearest first (mode 0); behind them, from `capacity` on, its first slot and that past its last, in map
// order (mode 1); and from three times that on, which Gaussians are visible, in map order (`compact_visible`).
@group(0) @binding(5) var<storage, read_write> intersection_counts: array<u32>;
// [visible / 256] intersections of each workgroup's Gaussians (mode 0), of those before it (mode 1).
@group(0) @binding(6) var<storage, read_write> block_sums: array<u32>;
// [intersections] tile, and the intersection's slot, before the tile sort.
@group(0) @binding(7) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> slots: array<u32>;
// [intersections] Gaussian of each slot.
@group(0) @binding(9) var<storage, read_write> slot_gaussians: array<u32>;

// Slack for rounding, absolute and relative: a tile too many costs time, one too few a seam.
const SLACK: f32 = 1e-3;

var<workgroup> found_here: atomic<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let rank = block * 256u + local;
    let is_there = rank < counters[VISIBLE_COUNTER].count;
    if setup.emit == 0u {
        if is_there {
            let found = list(rank, false, 0u);
            intersection_counts[rank] = found;
            atomicAdd(&found_here, found);
        }
        workgroupBarrier();
        if is_there && local == 0u {
            block_sums[block] = atomicLoad(&found_here);
        }
    } else {
        let found = select(0u, intersection_counts[rank], is_there);
        let slot = block_sums[block] + exclusive_sum(local, found);
        if is_there && counters[INTERSECTION_COUNTER].count > 0u {
            list(rank, true, slot);
        }
    }
}

// Counts the tiles of a Gaussian, or emits them from `slot` on; returns their number.
fn list(rank: u32, emit: bool, slot: u32) -> u32 {
    let gaussian = order[rank];
    let mean_cut = projected[3u * gaussian];
    let conic_factor = projected[3u * gaussian + 1u].xyz;
    let limit = mean_cut.w * (1.0 + SLACK) + SLACK;
    let mean = mean_cut.xy;
    let half_extent = unpack2x16float(bitcast<u32>(projected[3u * gaussian + 2u].w));
    let last_tile = vec2<f32>(f32(view.tiles_x), f32(view.tiles_y)) - 1.0;
    let tile_size = vec2(f32(TILE_WIDTH), f32(TILE_HEIGHT));
    // Pixel centres are integers, so a tile's pixels span [first, first + size - 1].
    let low = vec2<u32>(clamp(floor((mean - half_extent) / tile_size), vec2(0.0), last_tile));
    let high = vec2<u32>(clamp(floor((mean + half_extent) / tile_size), vec2(0.0), last_tile));
    var found = 0u;
    for (var y = low.y; y <= high.y; y++) {
        for (var x = low.x; x <= high.x; x++) {
            let tile = y * view.tiles_x + x;
            if !touches(mean, conic_factor, limit, vec2(f32(x), f32(y)) * tile_size, tile_size - 1.0) {
                continue;
            }
            if emit {
                tile_keys[slot + found] = tile;
                slots[slot + found] = slot + found;
                slot_gaussians[slot + found] = gaussian;
            }
            found++;
        }
    }
    if emit {
        intersection_counts[view.capacity + 2u * gaussian] = slot;
        intersection_counts[view.capacity + 2u * gaussian + 1u] = slot + found;
    }
    return found;
}

// Whether ½dᵀΣ⁻¹d ≤ limit somewhere on the rectangle [first, first + span], d measured from the mean. The form is convex: its minimum
// is 0 inside, else on one of the two edges that face the mean.
fn touches(mean: vec2<f32>, conic_factor: vec3<f32>, limit: f32, first: vec2<f32>, span: vec2<f32>) -> bool {
    let low = first - mean;
    let high = low + span;
    let nearest = clamp(vec2(0.0), low, high);
    if all(nearest == vec2(0.0)) {
        return true;
    }
    var smallest = 1e30;
    if nearest.x != 0.0 {
        let y = -conic_factor.x * conic_factor.y * nearest.x / (conic_factor.y * conic_factor.y + conic_factor.z * conic_factor.z);
        smallest = min(smallest, form(conic_factor, vec2(nearest.x, clamp(y, low.y, high.y))));
    }
    if nearest.y != 0.0 {
        let x = -conic_factor.y * nearest.y / conic_factor.x;
        smallest = min(smallest, form(conic_factor, vec2(clamp(x, low.x, high.x), nearest.y)));
    }
    return smallest <= limit;
}

fn form(conic_factor: vec3<f32>, d: vec2<f32>) -> f32 {
    let u = conic_factor.x * d.x + conic_factor.y * d.y;
    let v = conic_factor.z * d.y;
    return u * u + v * v;
}
