// Copies chosen Gaussians from one set of parameter planes to another: what pruning and growing the map come down to.
struct GatherSetup {
    count: u32,
    planes: u32,
    capacity_in: u32,
    capacity_out: u32,
}

@group(0) @binding(0) var<uniform> setup: GatherSetup;
@group(0) @binding(1) var<storage, read> chosen: array<u32>;
@group(0) @binding(2) var<storage, read> planes_in: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> planes_out: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i >= setup.count {
        return;
    }
    let from_ = chosen[i];
    for (var plane = 0u; plane < setup.planes; plane++) {
        planes_out[plane * setup.capacity_out + i] = planes_in[plane * setup.capacity_in + from_];
    }
}
