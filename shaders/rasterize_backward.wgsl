// Gradient of the blended image with respect to each (Gaussian, tile) pair, written to the pair's own slot: no atomics, and the sum
// over a Gaussian's slots runs in a fixed order.
//
// Front to back, as the forward pass goes: with w = αT, v·g = colour·g_colour + depth·g_depth and R the share of the pixel's value
// behind the Gaussian, ∂L/∂α = T(v·g) - R/(1-α). T is never recovered by division.

// [H, W] rendered (r, g, b, Σ w z) and (transmittance, last).
@group(0) @binding(5) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> state: array<vec2<f32>>;
// [2, H, W] gradients of the loss: plane 0 (r, g, b, Σ w z), plane 1 (alpha, -, -, -).
@group(0) @binding(7) var<storage, read> image_gradients: array<vec4<f32>>;
// [pairs, 3] (Σ w g_rgb, Σ w g_depth), (Σ q, Σ q dx, Σ q dy, 0), (Σ q dx², Σ q dx dy, Σ q dy², 0), q = ∂L/∂log α.
@group(0) @binding(8) var<storage, read_write> pair_gradients: array<vec4<f32>>;

const CHUNK: u32 = 8u;
const MASK_WORDS: u32 = (TILE_THREADS + 31u) / 32u;
// [CHUNK, 3, TILE_THREADS] what each invocation adds to each pair of the chunk, and [CHUNK, MASK_WORDS] which of them add anything.
var<workgroup> partial: array<vec4<f32>, CHUNK * 3u * TILE_THREADS>;
var<workgroup> touched: array<atomic<u32>, CHUNK * MASK_WORDS>;
var<workgroup> tile_last: atomic<u32>;

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

@compute @workgroup_size(TILE_THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = linear_workgroup(workgroup, workgroups);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let range = ranges[tile];
    let quad = quad_of(view, tile, local);
    var pixels = load_pixels(quad);
    let own_last = max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w));
    atomicMax(&tile_last, own_last);
    workgroupBarrier();
    let blended_end = range.x + workgroupUniformLoad(&tile_last);

    for (var start = range.x; start < blended_end; start += BATCH) {
        workgroupBarrier();
        load_batch(start, blended_end, local);
        workgroupBarrier();
        let end = min(BATCH, blended_end - start);
        for (var chunk = 0u; chunk < end; chunk += CHUNK) {
            let count = min(CHUNK, end - chunk);
            for (var k = 0u; k < count; k++) {
                blend_backward(k, chunk + k, start + chunk + k - range.x, quad, local, &pixels);
            }
            workgroupBarrier();
            if local < count * 3u {
                let slot = sorted_slots[start + chunk + local / 3u];
                pair_gradients[slot * 3u + local % 3u] = sum_touched(local);
            }
            workgroupBarrier();
            if local < CHUNK * MASK_WORDS {
                atomicStore(&touched[local], 0u);
            }
            workgroupBarrier();
        }
    }
    // Pairs behind every pixel's last contributor were not blended.
    for (var i = blended_end + local; i < range.y; i += TILE_THREADS) {
        let slot = sorted_slots[i];
        pair_gradients[slot * 3u] = vec4(0.0);
        pair_gradients[slot * 3u + 1u] = vec4(0.0);
        pair_gradients[slot * 3u + 2u] = vec4(0.0);
    }
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
    return pixels;
}

// Sum over the invocations that touched a pair, in their order; `item` counts [CHUNK, 3].
fn sum_touched(item: u32) -> vec4<f32> {
    var sum = vec4(0.0);
    for (var word = 0u; word < MASK_WORDS; word++) {
        var mask = atomicLoad(&touched[item / 3u * MASK_WORDS + word]);
        while mask != 0u {
            sum += partial[item * TILE_THREADS + word * 32u + firstTrailingBit(mask)];
            mask &= mask - 1u;
        }
    }
    return sum;
}

// One Gaussian, number `k` of the chunk, over this invocation's pixels; `position` counts from the start of the tile's list.
fn blend_backward(k: u32, in_batch: u32, position: u32, quad: Quad, local: u32, pixels: ptr<function, PixelState>) {
    let mean = batch_mean[in_batch];
    let shape = batch_whitening[in_batch];
    let distance = half_distance(mean.xy, shape.xyz, quad);
    let hit = (distance <= vec4(mean.w)) & (vec4(position) < (*pixels).last);
    if !any(hit) {
        return;
    }
    let unbounded = shape.w * exp(-distance);
    let alpha = select(vec4(0.0), min(vec4(ALPHA_MAX), unbounded), hit);
    let color = batch_color[in_batch];
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
    let to = k * 3u * TILE_THREADS + local;
    partial[to] = vec4(dot(weight, (*pixels).red), dot(weight, (*pixels).green), dot(weight, (*pixels).blue), dot(weight, (*pixels).depth));
    partial[to + TILE_THREADS] = vec4(dot(q, ones), dot(qx, ones), dot(qy, ones), 0.0);
    partial[to + 2u * TILE_THREADS] = vec4(dot(qx, dx), dot(qx, dy), dot(qy, dy), 0.0);
    atomicOr(&touched[k * MASK_WORDS + local / 32u], 1u << (local % 32u));
}
