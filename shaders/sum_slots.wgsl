// Sums the intersections of Gaussians that have many, so that `project_backward` keeps no invocation long: of each SLOT_CHUNK slots that belong to one Gaussian, the first
// becomes the sum. The order of the sums is fixed.

@group(0) @binding(0) var<storage, read> counters: array<Counter>;
// [intersections] Gaussian of each slot; [intersections, 3] see `IntersectionGradient`.
@group(0) @binding(1) var<storage, read> slot_gaussians: array<u32>;
@group(0) @binding(2) var<storage, read_write> intersection_gradients: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let first = (linear_workgroup(workgroup) * 64u + local) * SLOT_CHUNK;
    let end = first + SLOT_CHUNK;
    // A Gaussian's slots follow one another.
    if end > counters[INTERSECTION_COUNTER].count || slot_gaussians[first] != slot_gaussians[end - 1u] {
        return;
    }
    var color_depth = vec4(0.0);
    var first_moments = vec4(0.0);
    var second_moments = vec4(0.0);
    for (var slot = first; slot < end; slot++) {
        color_depth += intersection_gradients[slot * 3u];
        first_moments += intersection_gradients[slot * 3u + 1u];
        second_moments += intersection_gradients[slot * 3u + 2u];
    }
    intersection_gradients[first * 3u] = color_depth;
    intersection_gradients[first * 3u + 1u] = first_moments;
    intersection_gradients[first * 3u + 2u] = second_moments;
}
