// What each (Gaussian, tile) pair does to the pixels that it was really blended into, written over the pair's gradient, whose turn comes
// after: the raw material of density control (FastGS, arXiv 2511.04283; absolute gradients after AbsGS, arXiv 2404.10484).
//
// A pixel counts as wrong where its error exceeds a multiple of the view's mean error, and the noise of the sensor: one hot pixel
// does not rescale the mask, and a view that is good already has few.

struct ScoreSetup {
    // Multiple of the mean absolute error above which a pixel is wrong; and the error below which none is.
    error_ratio: f32,
    noise: f32,
    ssim_weight: f32,
    pixels: f32,
}

@group(0) @binding(9) var<uniform> setup: ScoreSetup;
// (Σ|colour error|, Σ SSIM, -, -) over the view's pixels and channels.
@group(0) @binding(10) var<uniform> total: vec4<f32>;

// Of a pair, over the pixels of its tile.
struct PairScore {
    // (wrong pixels, Σ w, largest w, 0), w what the Gaussian adds to a pixel.
    seen: vec4<f32>,
    // By the image mean, in pixels: (Σ ∂x, Σ ∂y, Σ|∂x|, Σ|∂y|).
    gradient: vec4<f32>,
}

const CHUNK: u32 = 8u;
// [CHUNK, 2, TILE_THREADS] what each invocation adds to each pair of the chunk.
var<workgroup> partial: array<vec4<f32>, CHUNK * 2u * TILE_THREADS>;

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
    let threshold = max(setup.noise, setup.error_ratio * total.x / (3.0 * setup.pixels));
    var quads: array<Quad, QUADS>;
    var pixels: array<PixelState, QUADS>;
    var wrong: array<vec4<f32>, QUADS>;
    for (var q = 0u; q < QUADS; q++) {
        quads[q] = quad_of(view, tile, local * QUADS + q);
        pixels[q] = load_pixels(quads[q]);
        wrong[q] = wrong_pixels(quads[q], threshold);
    }
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
                let mean = batch_mean[chunk + k];
                let shape = batch_whitening[chunk + k];
                let color = batch_color[chunk + k];
                var sum = PairScore(vec4(0.0), vec4(0.0));
                for (var q = 0u; q < QUADS; q++) {
                    var quad = pixels[q];
                    score_gaussian(mean, shape, color, start + chunk + k - range.x, quads[q], wrong[q], &quad, &sum);
                    pixels[q] = quad;
                }
                let to = k * 2u * TILE_THREADS + local;
                partial[to] = sum.seen;
                partial[to + TILE_THREADS] = sum.gradient;
            }
            workgroupBarrier();
            for (var item = local; item < count * 2u; item += TILE_THREADS) {
                var sum = vec4(0.0);
                var largest = 0.0;
                for (var i = 0u; i < TILE_THREADS; i++) {
                    let part = partial[item * TILE_THREADS + i];
                    sum += part;
                    largest = max(largest, part.z);
                }
                if item % 2u == 0u {
                    sum.z = largest;
                }
                let slot = sorted_slots[start + chunk + item / 2u];
                pair_gradients[slot * 3u + item % 2u] = sum;
            }
            workgroupBarrier();
        }
    }
    clear_unblended(blended_end, range.y, local);
}

// 1 where the pixel's error exceeds the threshold.
fn wrong_pixels(quad: Quad, threshold: f32) -> vec4<f32> {
    var wrong = vec4(0.0);
    for (var p = 0; p < 4; p++) {
        if quad.inside[p] && image_gradients[view.width * view.height + quad.index[p]].y > threshold {
            wrong[p] = 1.0;
        }
    }
    return wrong;
}

// Takes a quad past one Gaussian as `pass_gaussian` does, and adds to its score.
fn score_gaussian(
    mean: vec4<f32>,
    shape: vec4<f32>,
    color: vec4<f32>,
    position: u32,
    quad: Quad,
    wrong: vec4<f32>,
    pixels: ptr<function, PixelState>,
    sum: ptr<function, PairScore>,
) {
    let dy = quad.y - mean.y;
    let u = shape.x * (quad.x - mean.x) + shape.y * dy;
    let v = shape.z * dy;
    let distance = u * u + v * v;
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
    let q = select(vec4(0.0), gradient_alpha * alpha, hit & (unbounded <= vec4(ALPHA_MAX)));
    let by_x = 2.0 * q * shape.x * u;
    let by_y = 2.0 * q * (shape.y * u + shape.z * v);
    let ones = vec4(1.0);
    let blended = select(vec4(0.0), wrong, hit);
    let largest = max(max(weight.x, weight.y), max(weight.z, weight.w));
    let before = (*sum).seen;
    (*sum).seen = vec4(before.x + dot(blended, ones), before.y + dot(weight, ones), max(before.z, largest), 0.0);
    (*sum).gradient += vec4(dot(by_x, ones), dot(by_y, ones), dot(abs(by_x), ones), dot(abs(by_y), ones));
}
