// Gathers the visible Gaussians in map order: as a list, and as (depth key, index) pairs for the depth sort.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> prefix: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> indices: array<u32>;
// The list in map order goes to its last part; see `tile_lists`.
@group(0) @binding(6) var<storage, read_write> intersection_counts: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = linear_workgroup(workgroup, workgroups) * 256u + local;
    if i >= view.gaussian_count || visible[i] == 0u {
        return;
    }
    // The bits of positive floats sort as integers.
    let to = prefix[i];
    depth_keys[to] = bitcast<u32>(projected[3u * i].z);
    indices[to] = i;
    intersection_counts[3u * view.capacity + to] = i;
}
