// Finds where each tile's intersections begin and end in the sorted list.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<Counter>;
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
// [tiles] (first intersection, past the last).
@group(0) @binding(3) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup) * 256u + local;
    if tile < view.tiles_x * view.tiles_y {
        ranges[tile] = vec2(first_of(tile), first_of(tile + 1u));
    }
}

// The first intersection of a tile or of those behind it.
fn first_of(tile: u32) -> u32 {
    var low = 0u;
    var high = counters[INTERSECTION_COUNTER].count;
    while low < high {
        let middle = (low + high) / 2u;
        let is_before = tile_keys[middle] < tile;
        low = select(low, middle + 1u, is_before);
        high = select(middle, high, is_before);
    }
    return low;
}
