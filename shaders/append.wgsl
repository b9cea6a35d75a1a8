// Takes new Gaussians into the map: they are their own averages, without moments and without a history.
struct AppendSetup {
    // First place, and how many there are.
    first: u32,
    count: u32,
    capacity: u32,
    // Round in which they come.
    round: f32,
}

@group(0) @binding(0) var<uniform> setup: AppendSetup;
// [planes, count]
@group(0) @binding(1) var<storage, read> appended: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> parameters: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> moments_1: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> moments_2: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> averages: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> histories: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i >= setup.count {
        return;
    }
    let planes = arrayLength(&appended) / setup.count;
    for (var plane = 0u; plane < planes; plane++) {
        let value = appended[plane * setup.count + i];
        let to = plane * setup.capacity + setup.first + i;
        parameters[to] = value;
        averages[to] = value;
        moments_1[to] = vec4(0.0);
        moments_2[to] = vec4(0.0);
    }
    histories[setup.first + i] = vec4(0.0, 0.0, 0.0, setup.round);
}
