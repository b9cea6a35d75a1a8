// Finds where each tile's intersections begin and end in the sorted list. The ranges are cleared to (0, 0) beforehand.

@group(0) @binding(0) var<storage, read> counters: array<Counter>;
@group(0) @binding(1) var<storage, read> tile_keys: array<u32>;
// [tiles] (first intersection, past the last).
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_workgroup(workgroup, workgroups) * 256u + local;
    let count = counters[INTERSECTION_COUNTER].count;
    if i >= count {
        return;
    }
    let tile = tile_keys[i];
    if i == 0u || tile_keys[i - 1u] != tile {
        ranges[tile].x = i;
    }
    if i + 1u == count || tile_keys[i + 1u] != tile {
        ranges[tile].y = i + 1u;
    }
}
