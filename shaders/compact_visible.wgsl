// Gathers the visible Gaussians in map order: as a list, and as (depth key, index) pairs for the depth sort.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
// [N / 256] visible Gaussians before each workgroup's.
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> indices: array<u32>;
// The list in map order goes to its last part; see `tile_lists`.
@group(0) @binding(6) var<storage, read_write> intersection_counts: array<u32>;

// Who of the workgroup is visible, one bit each.
var<workgroup> masks: array<atomic<u32>, 8>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let i = block * 256u + local;
    let is_visible = i < view.gaussian_count && visible[min(i, view.gaussian_count - 1u)] == 1u;
    let word = local / 32u;
    let bit = 1u << (local % 32u);
    if local < 8u {
        atomicStore(&masks[local], 0u);
    }
    workgroupBarrier();
    if is_visible {
        atomicOr(&masks[word], bit);
    }
    workgroupBarrier();
    if !is_visible {
        return;
    }
    var to = block_sums[block] + countOneBits(atomicLoad(&masks[word]) & (bit - 1u));
    for (var before = 0u; before < word; before++) {
        to += countOneBits(atomicLoad(&masks[before]));
    }
    depth_keys[to] = depth_key(projected[PROJECTED * i].z);
    indices[to] = i;
    intersection_counts[3u * view.capacity + to] = i;
}

// 16 bits of a depth between NEAR_METRES and FAR_METRES: the bits of positive floats grow with them. Depths closer together than 1 in 3,000
// keep the order of the map. Host twin: `splat::model::depth_key`.
fn depth_key(depth: f32) -> u32 {
    return (bitcast<u32>(depth) - bitcast<u32>(NEAR_METRES)) / DEPTH_KEY_STEP;
}
