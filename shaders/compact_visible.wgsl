// Gathers the visible Gaussians in map order: as a list, and as (depth key, index) pairs for the narrow form's depth sort. Publishes their number, and clears the tiles'
// lists for the wide form.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
// [N / 256] visible Gaussians of each workgroup.
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> indices: array<u32>;
// The list in map order goes to its last part; see `tile_lists`.
@group(0) @binding(6) var<storage, read_write> intersection_counts: array<u32>;
@group(0) @binding(7) var<storage, read_write> counters: array<Counter>;
@group(0) @binding(8) var<storage, read_write> ranges: array<vec2<u32>>;

// Those of the workgroups before this one; then, of this one, who is visible, one bit each.
var<workgroup> before: atomic<u32>;
var<workgroup> masks: array<atomic<u32>, 8>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let blocks = max((view.gaussian_count + 255u) / 256u, 1u);
    let i = block * 256u + local;
    let is_visible = i < view.gaussian_count && visible[min(i, max(view.gaussian_count, 1u) - 1u)] == 1u;
    let word = local / 32u;
    let bit = 1u << (local % 32u);
    if local < 8u {
        atomicStore(&masks[local], 0u);
    }
    if local == 0u {
        atomicStore(&before, 0u);
    }
    workgroupBarrier();
    // Each workgroup adds up for itself what precedes it: a quarter of a thousand loads for each lane of the largest maps, instead of a pass.
    var sum = 0u;
    for (var k = local; k < min(block, arrayLength(&block_sums)); k += 256u) {
        sum += block_sums[k];
    }
    atomicAdd(&before, sum);
    if is_visible {
        atomicOr(&masks[word], bit);
    }
    workgroupBarrier();
    var to = atomicLoad(&before);
    for (var other = 0u; other < 8u; other++) {
        to += select(0u, countOneBits(atomicLoad(&masks[other])), other < word);
    }
    to += countOneBits(atomicLoad(&masks[word]) & (bit - 1u));
    if block == blocks - 1u && local == 255u {
        let count = to + select(0u, 1u, is_visible);
        counters[VISIBLE_COUNTER] = counter_of(count, count, 0u);
    }
    for (var tile = i; tile < view.tiles_x * view.tiles_y; tile += blocks * 256u) {
        ranges[tile] = vec2(0u);
    }
    if is_visible {
        depth_keys[to] = depth_key(projected[PROJECTED * i].z);
        indices[to] = i;
        intersection_counts[3u * view.capacity + to] = i;
    }
}
