// Photometric and depth loss of a rendered view, and what the backward pass needs of SSIM: its partial derivatives by the local mean,
// mean square and mean product. L = (1-λ)·L1 + λ·(1-SSIM) + λ_depth·|Σ w z - (1-T)·sensor depth|, means over the image.

struct LossSetup {
    width: u32,
    height: u32,
    // λ: share of SSIM.
    ssim_weight: f32,
    // λ_depth per metre; 0 without depth.
    depth_weight: f32,
}

@group(0) @binding(0) var<uniform> setup: LossSetup;
// [H, W] rendered (r, g, b, Σ w z); (transmittance, -).
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<f32>>;
// [H, W] the keyframe: 8-bit RGBA, and sensor depth in metres (0: not measured).
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3, H, W] ∂SSIM/∂(mean, mean square, mean product) per channel.
@group(0) @binding(5) var<storage, read_write> partials: array<vec4<f32>>;
// [workgroups] sums of |colour error|, SSIM, |depth error|, squared colour error.
@group(0) @binding(6) var<storage, read_write> loss_sums: array<vec4<f32>>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> source: array<vec2<f32>, 676>;
// Row-filtered x, y, x², y², xy: [26 rows, 16 columns].
var<workgroup> rows_means: array<vec2<f32>, 416>;
var<workgroup> rows_squares: array<vec2<f32>, 416>;
var<workgroup> rows_product: array<f32, 416>;
var<workgroup> sums: array<vec4<f32>, 256>;

struct Ssim {
    value: f32,
    by_mean: f32,
    by_square: f32,
    by_product: f32,
}

@compute @workgroup_size(16, 16)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) at: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixel = workgroup.xy * 16u + at.xy;
    let inside = pixel.x < setup.width && pixel.y < setup.height;
    let index = pixel.y * setup.width + pixel.x;
    var by_mean = vec4(0.0);
    var by_square = vec4(0.0);
    var by_product = vec4(0.0);
    var sum = vec4(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        load_tile(workgroup.xy, channel, local);
        workgroupBarrier();
        let own = source[(at.y + RADIUS) * SPAN + at.x + RADIUS];
        filter_rows(local);
        workgroupBarrier();
        if inside {
            let ssim = filter_columns(at.xy);
            by_mean[channel] = ssim.by_mean;
            by_square[channel] = ssim.by_square;
            by_product[channel] = ssim.by_product;
            let error = own.x - own.y;
            sum += vec4(abs(error), ssim.value, 0.0, error * error);
        }
        workgroupBarrier();
    }
    if inside {
        let pixels = setup.width * setup.height;
        partials[index] = by_mean;
        partials[pixels + index] = by_square;
        partials[2u * pixels + index] = by_product;
        let measured = target_depth[index];
        if setup.depth_weight > 0.0 && measured > 0.0 {
            sum.z = abs(color_depth[index].w - (1.0 - state[index].x) * measured);
        }
    }
    sums[local] = sum;
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            sums[local] += sums[local + stride];
        }
    }
    if local == 0u {
        loss_sums[workgroup.y * workgroups.x + workgroup.x] = sums[0];
    }
}

fn load_tile(workgroup: vec2<u32>, channel: u32, local: u32) {
    for (var k = local; k < SPAN * SPAN; k += 256u) {
        let pixel = vec2<i32>(workgroup * 16u + vec2(k % SPAN, k / SPAN)) - i32(RADIUS);
        var value = vec2(0.0);
        if all(pixel >= vec2(0)) && pixel.x < i32(setup.width) && pixel.y < i32(setup.height) {
            let i = u32(pixel.y) * setup.width + u32(pixel.x);
            value = vec2(color_depth[i][channel], unpack4x8unorm(target_color[i])[channel]);
        }
        source[k] = value;
    }
}

fn filter_rows(local: u32) {
    for (var k = local; k < 416u; k += 256u) {
        let first = (k / 16u) * SPAN + k % 16u;
        var means = vec2(0.0);
        var squares = vec2(0.0);
        var product = 0.0;
        for (var tap = 0u; tap < 11u; tap++) {
            let value = source[first + tap];
            let weighted = WINDOW[tap] * value;
            means += weighted;
            squares += weighted * value;
            product += weighted.x * value.y;
        }
        rows_means[k] = means;
        rows_squares[k] = squares;
        rows_product[k] = product;
    }
}

fn filter_columns(at: vec2<u32>) -> Ssim {
    var means = vec2(0.0);
    var squares = vec2(0.0);
    var product = 0.0;
    for (var tap = 0u; tap < 11u; tap++) {
        let k = (at.y + tap) * 16u + at.x;
        means += WINDOW[tap] * rows_means[k];
        squares += WINDOW[tap] * rows_squares[k];
        product += WINDOW[tap] * rows_product[k];
    }
    return ssim_of(means, squares, product);
}

fn ssim_of(means: vec2<f32>, squares: vec2<f32>, product: f32) -> Ssim {
    // Rounding can make a variance negative; it is then a constant 0.
    let raw = squares - means * means;
    let variance = max(raw, vec2(0.0));
    let free = select(0.0, 1.0, raw.x > 0.0);
    let a1 = 2.0 * means.x * means.y + C1;
    let a2 = 2.0 * (product - means.x * means.y) + C2;
    let b1 = means.x * means.x + means.y * means.y + C1;
    let b2 = variance.x + variance.y + C2;
    let value = a1 * a2 / (b1 * b2);
    let by_variance = -value / b2 * free;
    let by_covariance = 2.0 * a1 / (b1 * b2);
    let by_mean = 2.0 * means.y * a2 / (b1 * b2) - 2.0 * means.x * value / b1 - 2.0 * means.x * by_variance - means.y * by_covariance;
    return Ssim(value, by_mean, by_variance, by_covariance);
}
