// Marks the Gaussians that no step moves: lane w of plane 1 in the second moments, which Adam has no other use for.
struct FixSetup {
    count: u32,
    capacity: u32,
}

@group(0) @binding(0) var<uniform> setup: FixSetup;
// [N] bits
@group(0) @binding(1) var<storage, read> fixed: array<u32>;
@group(0) @binding(2) var<storage, read_write> moments_2: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i < setup.count {
        moments_2[setup.capacity + i].w = f32(extractBits(fixed[i / 32u], i % 32u, 1u));
    }
}
