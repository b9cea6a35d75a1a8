// What density control makes of each Gaussian: one word with a verdict and the score by which the host ranks it.

// [planes, capacity] averaged parameters.
@group(0) @binding(2) var<storage, read> averages: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> histories: array<vec4<f32>>;
// [N] VERDICT_* | SEEN | FAINT | upper bits of a score ≥ 0.
@group(0) @binding(4) var<storage, read_write> verdicts: array<u32>;

// Bits of an infinity's exponent: all are set in what is not finite.
const EXPONENT: vec4<u32> = vec4(0x7f800000u);

fn is_finite(v: vec4<f32>) -> bool {
    return all((bitcast<vec4<u32>>(v) & EXPONENT) != EXPONENT);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i >= setup.count {
        return;
    }
    let position = averages[i];
    let log_scale = averages[setup.capacity + i];
    let rotation = averages[2u * setup.capacity + i];
    let seen = scores[i];
    let by_view = scores[setup.capacity + i];
    let history = remembered(histories[i], i);
    let longest = max(max(log_scale.x, log_scale.y), log_scale.z);
    let log_pixels = longest - log(max(by_view.w, 1e-9));
    let views = by_view.z;
    let is_seen = views > 0.0;
    let is_old = setup.round - history.w >= setup.min_age;

    var verdict = VERDICT_KEEP;
    var score = 0.0;
    var flags = select(0u, SEEN, is_seen);
    let adds_little = history.y < setup.min_weight || history.z < setup.min_contribution;
    if is_old && history.x >= setup.min_views && adds_little {
        verdict = VERDICT_REMOVE;
    }
    if is_old && is_seen && position.w < setup.faint_raw_opacity {
        flags |= FAINT;
        score = seen.y;
    } else if verdict == VERDICT_KEEP && is_old && is_seen && seen.x > setup.error_pixels * views
        && by_view.y > setup.pixel_gradient * views && log_pixels > setup.split_log_pixels {
        verdict = VERDICT_SPLIT;
        score = seen.x / views;
    }
    if is_seen && by_view.x >= setup.gradient * views {
        verdict = select(VERDICT_CLONE, VERDICT_SPLIT, log_pixels > setup.split_or_clone_log_pixels);
    }
    let is_valid = is_finite(position) && is_finite(log_scale) && is_finite(rotation)
        && position.w >= setup.min_raw_opacity && longest <= setup.max_log_scale;
    if !is_valid {
        verdict = VERDICT_REMOVE;
    }
    verdicts[i] = (bitcast<u32>(score) & ~VERDICT_BITS) | verdict | flags;
}
