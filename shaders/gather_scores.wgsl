// Sums the intersections' scores to each visible Gaussian, in order, and adds a view's to those of the views before.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<Counter>;
// See `tile_lists`.
@group(0) @binding(2) var<storage, read> intersection_counts: array<u32>;
@group(0) @binding(3) var<storage, read> intersection_scores: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;
// [2, capacity], see `GaussianScore`: (error pixels, the same times each view's loss, Σ w, largest w); (‖∂‖ in normalised device coordinates, ‖Σ|∂|‖ of the
// pixels' summed loss a pixel, views that blended it, finest metres per pixel).
@group(0) @binding(5) var<storage, read_write> scores: array<vec4<f32>>;
@group(0) @binding(6) var<uniform> setup: ScoreSetup;
@group(0) @binding(7) var<uniform> total: vec4<f32>;

struct ScoreSetup {
    error_ratio: f32,
    noise: f32,
    ssim_weight: f32,
    pixels: f32,
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let item = linear_workgroup(workgroup) * 256u + local;
    // Without room for all intersections nothing was rendered: the step will be repeated.
    if item >= counters[VISIBLE_COUNTER].count || counters[INTERSECTION_COUNTER].count == 0u {
        return;
    }
    let i = intersection_counts[3u * view.capacity + item];
    let end = intersection_counts[view.capacity + 2u * i + 1u];
    var blended = vec4(0.0);
    var gradient = vec4(0.0);
    for (var slot = intersection_counts[view.capacity + 2u * i]; slot < end; slot++) {
        let part = intersection_scores[slot * 3u];
        blended = vec4(blended.xy + part.xy, max(blended.z, part.z), 0.0);
        gradient += intersection_scores[slot * 3u + 1u];
    }
    if blended.y == 0.0 {
        return;
    }
    let values = 3.0 * setup.pixels;
    let loss = (1.0 - setup.ssim_weight) * total.x / values + setup.ssim_weight * (1.0 - total.y / values);
    let per_unit = 0.5 * vec2(f32(view.width), f32(view.height));
    let metres_per_pixel = projected[PROJECTED * i].z / view.intrinsics.x;
    let before = scores[view.capacity + i];
    let finest = select(metres_per_pixel, min(before.w, metres_per_pixel), before.z > 0.0);
    let seen_before = scores[i];
    scores[i] = vec4(
        seen_before.x + blended.x,
        seen_before.y + blended.x * loss,
        seen_before.z + blended.y,
        max(seen_before.w, blended.z),
    );
    let norms = vec2(length(gradient.xy * per_unit), length(gradient.zw) * setup.pixels);
    scores[view.capacity + i] = vec4(before.xy + norms, before.z + 1.0, finest);
}
