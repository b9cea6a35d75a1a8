// Sums neighbouring intersections of one Gaussian in place, so that no Gaussian is left with more than one of SLOT_CHUNK: each invocation takes a chunk of slots and
// leaves the sum of a Gaussian's slots in the first of them. All invocations have the same work, and the order of the sums is fixed.

@group(0) @binding(0) var<storage, read> counters: array<Counter>;
// [intersections] Gaussian of each slot; [intersections, 3] see `IntersectionGradient`.
@group(0) @binding(1) var<storage, read> slot_gaussians: array<u32>;
@group(0) @binding(2) var<storage, read_write> intersection_gradients: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let first = (linear_workgroup(workgroup) * 64u + local) * SLOT_CHUNK;
    let end = min(first + SLOT_CHUNK, counters[INTERSECTION_COUNTER].count);
    var to = first;
    var gaussian = slot_gaussians[min(first, max(end, 1u) - 1u)];
    var color_depth = vec4(0.0);
    var first_moments = vec4(0.0);
    var second_moments = vec4(0.0);
    for (var slot = first; slot < end; slot++) {
        let next = slot_gaussians[slot];
        if next != gaussian {
            store(to, color_depth, first_moments, second_moments);
            to = slot;
            gaussian = next;
            color_depth = vec4(0.0);
            first_moments = vec4(0.0);
            second_moments = vec4(0.0);
        }
        color_depth += intersection_gradients[slot * 3u];
        first_moments += intersection_gradients[slot * 3u + 1u];
        second_moments += intersection_gradients[slot * 3u + 2u];
    }
    if first < end {
        store(to, color_depth, first_moments, second_moments);
    }
}

fn store(slot: u32, color_depth: vec4<f32>, first: vec4<f32>, second: vec4<f32>) {
    intersection_gradients[slot * 3u] = color_depth;
    intersection_gradients[slot * 3u + 1u] = first;
    intersection_gradients[slot * 3u + 2u] = second;
}
