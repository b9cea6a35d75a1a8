// What both forms of the blending's backward pass share: the pixels' state and what one Gaussian does to it.
//
// Front to back, as the forward pass goes: with w = αT, v·g = colour·g_colour + depth·g_depth and R the share of the pixel's value
// behind the Gaussian, ∂L/∂α = T(v·g) - R/(1-α). T is never recovered by division.

// [H, W] rendered (r, g, b, Σ w z) and (transmittance, last).
@group(0) @binding(5) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> state: array<vec2<f32>>;
// [2, H, W] gradients of the loss: plane 0 (r, g, b, Σ w z), plane 1 (alpha, |error|, -, -).
@group(0) @binding(7) var<storage, read> image_gradients: array<vec4<f32>>;
// [pairs, 3] see `PairGradient`.
@group(0) @binding(8) var<storage, read_write> pair_gradients: array<vec4<f32>>;

var<workgroup> tile_last: atomic<u32>;

// A quad of pixels, in its lanes.
struct PixelState {
    transmittance: vec4<f32>,
    // Pixel value behind the current Gaussian, dotted with the gradient.
    behind: vec4<f32>,
    last: vec4<u32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
}

// Gradient of a pair, q = ∂L/∂log α.
struct PairGradient {
    // (Σ w g_rgb, Σ w g_depth)
    color_depth: vec4<f32>,
    // (Σ q, Σ q dx, Σ q dy, 0)
    first: vec4<f32>,
    // (Σ q dx², Σ q dx dy, Σ q dy², 0)
    second: vec4<f32>,
}

fn load_pixels(quad: Quad) -> PixelState {
    var pixels: PixelState;
    pixels.transmittance = vec4(1.0);
    for (var p = 0; p < 4; p++) {
        if !quad.inside[p] {
            continue;
        }
        let i = quad.index[p];
        let gradient = image_gradients[i];
        let gradient_alpha = image_gradients[view.width * view.height + i].x;
        let final_state = state[i];
        let rendered = color_depth[i];
        pixels.red[p] = gradient.x;
        pixels.green[p] = gradient.y;
        pixels.blue[p] = gradient.z;
        pixels.depth[p] = gradient.w;
        pixels.last[p] = bitcast<u32>(final_state.y);
        // Behind the first Gaussian lies everything blended, the background (it is in `rendered`) and, as alpha is 1 - T, its gradient.
        pixels.behind[p] = dot(rendered, gradient) - final_state.x * gradient_alpha;
    }
    atomicMax(&tile_last, max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w)));
    return pixels;
}

// Takes a quad past one Gaussian, the one at `position` in the tile's list, and adds to its gradient.
fn pass_gaussian(
    mean: vec4<f32>,
    shape: vec4<f32>,
    color: vec4<f32>,
    position: u32,
    quad: Quad,
    pixels: ptr<function, PixelState>,
    sum: ptr<function, PairGradient>,
) {
    let distance = half_distance(mean.xy, shape.xyz, quad);
    let hit = (distance <= vec4(mean.w)) & (vec4(position) < (*pixels).last);
    if !any(hit) {
        return;
    }
    let unbounded = shape.w * exp(-distance);
    let alpha = select(vec4(0.0), min(vec4(ALPHA_MAX), unbounded), hit);
    let value = (*pixels).red * color.x + (*pixels).green * color.y + (*pixels).blue * color.z + (*pixels).depth * mean.z;
    let weight = alpha * (*pixels).transmittance;
    (*pixels).behind -= weight * value;
    let gradient_alpha = (*pixels).transmittance * value - (*pixels).behind / (1.0 - alpha);
    (*pixels).transmittance *= 1.0 - alpha;
    // Above the cap alpha no longer depends on shape and opacity.
    let q = select(vec4(0.0), gradient_alpha * alpha, hit & (unbounded <= vec4(ALPHA_MAX)));
    let dx = quad.x - mean.x;
    let dy = quad.y - mean.y;
    let qx = q * dx;
    let qy = q * dy;
    let ones = vec4(1.0);
    (*sum).color_depth +=
        vec4(dot(weight, (*pixels).red), dot(weight, (*pixels).green), dot(weight, (*pixels).blue), dot(weight, (*pixels).depth));
    (*sum).first += vec4(dot(q, ones), dot(qx, ones), dot(qy, ones), 0.0);
    (*sum).second += vec4(dot(qx, dx), dot(qx, dy), dot(qy, dy), 0.0);
}

// Pairs behind every pixel's last contributor were not blended.
fn clear_unblended(first: u32, end: u32, local: u32) {
    for (var i = first + local; i < end; i += TILE_THREADS) {
        let slot = sorted_slots[i];
        pair_gradients[slot * 3u] = vec4(0.0);
        pair_gradients[slot * 3u + 1u] = vec4(0.0);
        pair_gradients[slot * 3u + 2u] = vec4(0.0);
    }
}
