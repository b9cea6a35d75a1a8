// Photometric and depth loss of a rendered view, and what the backward pass needs of SSIM: its partial derivatives by the local mean,
// mean square and mean product. L = (1-λ)·L1 + λ·(1-SSIM) + λ_depth·|Σ w z - (1-T)·sensor depth|, means over the image.

@group(0) @binding(0) var<uniform> setup: LossSetup;
// [H, W] rendered (r, g, b, Σ w z); (transmittance, -).
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<f32>>;
// [H, W] the keyframe: 8-bit RGBA, and sensor depth in metres (0: not measured).
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3 channels, bordered H, bordered W] ∂SSIM/∂(mean, mean square, mean product), zero on the border.
@group(0) @binding(5) var<storage, read_write> partials: array<vec4<f32>>;
// [workgroups] sums of |colour error|, SSIM, |depth error|, squared colour error.
@group(0) @binding(6) var<storage, read_write> loss_sums: array<vec4<f32>>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> source: array<vec2<f32>, 676>;
// [26 rows, 16 columns] filtered along rows.
var<workgroup> rows: array<vec4<f32>, 416>;
var<workgroup> sums: array<vec4<f32>, 64>;

// Filtered (x, y, x² + y², xy) of four outputs: SSIM needs the variances' sum only.
struct Moments {
    at: array<vec4<f32>, 4>,
}

struct Ssim {
    value: vec4<f32>,
    by_mean: vec4<f32>,
    by_square: vec4<f32>,
    by_product: vec4<f32>,
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    // Four pixels of one column.
    let column = local % 16u;
    let row = local / 16u * 4u;
    let x = workgroup.x * 16u + column;
    let y = workgroup.y * 16u + row;
    var sum = vec4(0.0);
    let inside = select(vec4(0.0), vec4(1.0), (vec4(y) + vec4(0u, 1u, 2u, 3u) < vec4(setup.height)) & vec4(x < setup.width));
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        load_tile(workgroup.xy, channel, local);
        workgroupBarrier();
        for (var item = local; item < SPAN * 4u; item += 64u) {
            filter_row(item / 4u, item % 4u * 4u);
        }
        workgroupBarrier();
        let ssim = ssim_of(filter_column(column, row));
        let own = (row + RADIUS) * SPAN + column + RADIUS;
        for (var k = 0u; k < 4u; k++) {
            if inside[k] > 0.0 {
                let to = (channel * bordered(setup.height) + y + k + RADIUS) * bordered(setup.width) + x + RADIUS;
                partials[to] = vec4(ssim.by_mean[k], ssim.by_square[k], ssim.by_product[k], 0.0);
            }
            let pair = source[own + k * SPAN];
            let error = pair.x - pair.y;
            sum += inside[k] * vec4(abs(error), ssim.value[k], 0.0, error * error);
        }
    }
    for (var k = 0u; k < 4u; k++) {
        if inside[k] > 0.0 {
            let index = (y + k) * setup.width + x;
            let measured = target_depth[index];
            if setup.depth_weight > 0.0 && measured > 0.0 {
                sum.z += abs(color_depth[index].w - (1.0 - state[index].x) * measured);
            }
        }
    }
    sums[local] = sum;
    for (var stride = 32u; stride > 0u; stride /= 2u) {
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
    for (var k = local; k < SPAN * SPAN; k += 64u) {
        let pixel = vec2<i32>(workgroup * 16u + vec2(k % SPAN, k / SPAN)) - i32(RADIUS);
        var value = vec2(0.0);
        if all(pixel >= vec2(0)) && pixel.x < i32(setup.width) && pixel.y < i32(setup.height) {
            let i = u32(pixel.y) * setup.width + u32(pixel.x);
            value = vec2(color_depth[i][channel], unpack4x8unorm(target_color[i])[channel]);
        }
        source[k] = value;
    }
}

fn add(sum: ptr<function, Moments>, value: vec4<f32>, taps: vec4<f32>) {
    // The taps are constants: a zero one costs nothing.
    if taps.x != 0.0 {
        (*sum).at[0] += taps.x * value;
    }
    if taps.y != 0.0 {
        (*sum).at[1] += taps.y * value;
    }
    if taps.z != 0.0 {
        (*sum).at[2] += taps.z * value;
    }
    if taps.w != 0.0 {
        (*sum).at[3] += taps.w * value;
    }
}

fn quantities(at: u32) -> vec4<f32> {
    let value = source[at];
    return vec4(value, dot(value, value), value.x * value.y);
}

// Four outputs of one row, from column `first` of the tile on.
fn filter_row(row: u32, first: u32) {
    let at = row * SPAN + first;
    var sum: Moments;
    add(&sum, quantities(at + 0u), T0);
    add(&sum, quantities(at + 1u), T1);
    add(&sum, quantities(at + 2u), T2);
    add(&sum, quantities(at + 3u), T3);
    add(&sum, quantities(at + 4u), T4);
    add(&sum, quantities(at + 5u), T5);
    add(&sum, quantities(at + 6u), T6);
    add(&sum, quantities(at + 7u), T7);
    add(&sum, quantities(at + 8u), T8);
    add(&sum, quantities(at + 9u), T9);
    add(&sum, quantities(at + 10u), T10);
    add(&sum, quantities(at + 11u), T11);
    add(&sum, quantities(at + 12u), T12);
    add(&sum, quantities(at + 13u), T13);
    for (var k = 0u; k < 4u; k++) {
        rows[row * 16u + first + k] = sum.at[k];
    }
}

// Four outputs of one column, from row `first` of the tile on.
fn filter_column(column: u32, first: u32) -> Moments {
    let at = first * 16u + column;
    var sum: Moments;
    add(&sum, rows[at + 0u], T0);
    add(&sum, rows[at + 16u], T1);
    add(&sum, rows[at + 32u], T2);
    add(&sum, rows[at + 48u], T3);
    add(&sum, rows[at + 64u], T4);
    add(&sum, rows[at + 80u], T5);
    add(&sum, rows[at + 96u], T6);
    add(&sum, rows[at + 112u], T7);
    add(&sum, rows[at + 128u], T8);
    add(&sum, rows[at + 144u], T9);
    add(&sum, rows[at + 160u], T10);
    add(&sum, rows[at + 176u], T11);
    add(&sum, rows[at + 192u], T12);
    add(&sum, rows[at + 208u], T13);
    return sum;
}

fn ssim_of(m: Moments) -> Ssim {
    let mean_x = vec4(m.at[0].x, m.at[1].x, m.at[2].x, m.at[3].x);
    let mean_y = vec4(m.at[0].y, m.at[1].y, m.at[2].y, m.at[3].y);
    let squares = vec4(m.at[0].z, m.at[1].z, m.at[2].z, m.at[3].z);
    let product = vec4(m.at[0].w, m.at[1].w, m.at[2].w, m.at[3].w);
    // Rounding can make the sum of the variances negative; it is then a constant 0.
    let means = mean_x * mean_x + mean_y * mean_y;
    let variances = max(squares - means, vec4(0.0));
    let free = select(vec4(0.0), vec4(1.0), squares > means);
    let a1 = 2.0 * mean_x * mean_y + C1;
    let a2 = 2.0 * (product - mean_x * mean_y) + C2;
    let b1 = 1.0 / (means + C1);
    let b2 = 1.0 / (variances + C2);
    let value = a1 * a2 * b1 * b2;
    let by_variance = -value * b2 * free;
    let by_covariance = 2.0 * a1 * b1 * b2;
    let by_mean = 2.0 * mean_y * a2 * b1 * b2 - 2.0 * mean_x * (value * b1 + by_variance) - mean_y * by_covariance;
    return Ssim(value, by_mean, by_variance, by_covariance);
}
