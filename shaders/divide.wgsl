// Two Gaussians in place of one, along its longest axis; both have been gathered as copies of it.
//
// Split: narrower ones that look together much as it did (their alphas differ from it by at most 0.07 of its own along the axis). Clone: two like it,
// with 1 - √(1 - α) each, so that both together let as much light pass.
struct DivideSetup {
    // First child, and how many there are.
    first: u32,
    children: u32,
    // Place of the first parent among the changes.
    parents: u32,
    capacity: u32,
    // Round in which they come.
    round: f32,
}

@group(0) @binding(0) var<uniform> setup: DivideSetup;
// See `gather`.
@group(0) @binding(1) var<storage, read> changes: array<u32>;
@group(0) @binding(2) var<storage, read_write> parameters: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> averages: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> histories: array<vec4<f32>>;

// Along the unit axis `k` of a Gaussian, in the world; its rotation is (w, x, y, z).
fn axis_in_world(rotation: vec4<f32>, k: u32) -> vec3<f32> {
    let q = rotation / length(rotation);
    var axis = vec3(0.0);
    axis[k] = 1.0;
    let across = 2.0 * cross(q.yzw, axis);
    return axis + q.x * across + cross(q.yzw, across);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let child = linear_workgroup(workgroup) * 256u + local;
    if child >= setup.children {
        return;
    }
    let i = setup.first + child;
    let position = averages[i];
    var log_scale = averages[setup.capacity + i];
    var longest = 0u;
    if log_scale.y > log_scale.x {
        longest = 1u;
    }
    if log_scale.z > log_scale[longest] {
        longest = 2u;
    }
    let opacity = 1.0 / (1.0 + exp(-position.w));
    let metres = exp(log_scale[longest]);
    var apart = 0.6 * metres;
    var each = 0.85 * opacity;
    if (changes[setup.parents + child / 2u] & DIVIDED_BY_CLONING) != 0u {
        apart = 0.25 * metres;
        each = 1.0 - sqrt(1.0 - opacity);
    } else {
        log_scale[longest] += log(0.7);
    }
    let side = select(-apart, apart, child % 2u == 1u);
    let offset = side * axis_in_world(averages[2u * setup.capacity + i], longest);
    let divided = vec4(position.xyz + offset, log(each / (1.0 - each)));
    parameters[i] = divided;
    averages[i] = divided;
    parameters[setup.capacity + i] = log_scale;
    averages[setup.capacity + i] = log_scale;
    // Their averages begin anew.
    averages[3u * setup.capacity + i].w = 0.0;
    histories[i] = vec4(0.0, 0.0, 0.0, setup.round);
}
