// Density control's rules, and what it remembers of each Gaussian. Host twin of the setup: `render::layout::DensitySetup`.
struct DensitySetup {
    count: u32,
    // Stride between planes.
    capacity: u32,
    // Rounds of density control so far, this one included.
    round: f32,
    // Validity, whatever the strategy: logit of the opacity, natural logarithm of metres.
    min_raw_opacity: f32,
    max_log_scale: f32,
    // Multi-view, beyond all values where another strategy rules: see `MultiViewConfig`; the opacity as its logit, the pixels as their natural logarithm.
    min_age: f32,
    min_views: f32,
    min_weight: f32,
    min_contribution: f32,
    faint_raw_opacity: f32,
    error_pixels: f32,
    pixel_gradient: f32,
    split_log_pixels: f32,
    // 3DGS, beyond all values where another strategy rules: see `ClassicConfig`.
    gradient: f32,
    split_or_clone_log_pixels: f32,
}

@group(0) @binding(0) var<uniform> setup: DensitySetup;
// [2, capacity], see `gather_scores`.
@group(0) @binding(1) var<storage, read> scores: array<vec4<f32>>;

// A Gaussian's history, see `GaussianHistory`, with what the scored views add to it: (views, largest w, most Σ w of a view, round in which it came).
fn remembered(history: vec4<f32>, i: u32) -> vec4<f32> {
    let seen = scores[i];
    let views = scores[setup.capacity + i].z;
    return vec4(history.x + views, max(history.y, seen.w), max(history.z, seen.z / max(views, 1.0)), history.w);
}
