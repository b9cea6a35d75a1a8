// Moves Gaussians by similarities, one buffer a dispatch: centres, sizes, orientations, and harmonics above the constant, which is the same in
// every direction.
struct TransformSetup {
    // First Gaussian, and the end.
    first: u32,
    end: u32,
    capacity: u32,
}

// Of a motion: three rows (M, t) of the displacement new - old = M p + t; the rotation (w, x, y, z); the scale and its logarithm; then the
// harmonics' matrices of degree 1, 2 and 3, row-major, four values a vec4.
const MOTION_ROWS: u32 = 26u;
const MATRICES: u32 = 5u;
const INVOCATIONS: u32 = 64u;

@group(0) @binding(0) var<uniform> setup: TransformSetup;
// [runs] first Gaussian, end, place of the motion; ascending
@group(0) @binding(1) var<storage, read> runs: array<vec4<u32>>;
// [motions, MOTION_ROWS]
@group(0) @binding(2) var<storage, read> motions: array<vec4<f32>>;
// [planes, capacity]
@group(0) @binding(3) var<storage, read_write> values: array<vec4<f32>>;

// Harmonics of one degree before the motion, at most seven, for each invocation.
var<workgroup> old: array<vec3<f32>, 448>;

// Number of runs that begin at or before a Gaussian.
fn runs_up_to(i: u32) -> u32 {
    var low = 0u;
    var high = arrayLength(&runs);
    while low < high {
        let middle = (low + high) / 2u;
        if runs[middle].x <= i {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

fn product(a: vec4<f32>, b: vec4<f32>) -> vec4<f32> {
    return vec4((a.x * b.x) - dot(a.yzw, b.yzw), (a.x * b.yzw) + (b.x * a.yzw) + cross(a.yzw, b.yzw));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = setup.first + (linear_workgroup(workgroup) * INVOCATIONS) + local;
    let up_to = runs_up_to(i);
    if i >= setup.end || up_to == 0u || i >= runs[up_to - 1u].y {
        return;
    }
    let motion = runs[up_to - 1u].z * MOTION_ROWS;

    let center = values[i];
    let p = vec4(center.xyz, 1.0);
    let shift = vec3(dot(motions[motion], p), dot(motions[motion + 1u], p), dot(motions[motion + 2u], p));
    values[i] = vec4(center.xyz + shift, center.w);
    let growth = motions[motion + 4u];
    let scales = values[setup.capacity + i];
    values[setup.capacity + i] = vec4(scales.xyz + growth.y, scales.w * growth.x);
    values[(2u * setup.capacity) + i] = product(motions[motion + 3u], values[(2u * setup.capacity) + i]);

    let coefficients = (arrayLength(&values) / setup.capacity) - 3u;
    var matrix = (motion + MATRICES) * 4u;
    for (var degree = 1u; degree * degree < coefficients; degree++) {
        let count = (2u * degree) + 1u;
        let first = ((3u + (degree * degree)) * setup.capacity) + i;
        for (var k = 0u; k < count; k++) {
            old[(k * INVOCATIONS) + local] = values[first + (k * setup.capacity)].xyz;
        }
        for (var row = 0u; row < count; row++) {
            var sum = vec3(0.0);
            for (var k = 0u; k < count; k++) {
                let element = matrix + (row * count) + k;
                sum += motions[element / 4u][element % 4u] * old[(k * INVOCATIONS) + local];
            }
            let at = first + (row * setup.capacity);
            values[at] = vec4(sum, values[at].w);
        }
        matrix += count * count;
    }
}
