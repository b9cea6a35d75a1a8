// Adds what the scored views say of each Gaussian to its history.

@group(0) @binding(2) var<storage, read_write> histories: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i < setup.count {
        histories[i] = remembered(histories[i], i);
    }
}
