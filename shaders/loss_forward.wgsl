// Photometric and depth loss of a rendered view, and what the backward pass needs of SSIM: its partial derivatives by the local mean,
// mean square and mean product. L = (1-λ)·L1 + λ·(1-SSIM) + λ_depth·p·|Σ w z - (1-T)·sensor depth|, p the sensor's precision there, means over the image.

@group(0) @binding(0) var<uniform> setup: LossSetup;
// [H, W] rendered (r, g, b, Σ w z); (transmittance, -).
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<f32>>;
// [H, W] the keyframe: 8-bit RGBA, all 0 where nothing was recorded; and sensor depth in metres (0: not measured).
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3 channels, bordered windows along y, along x] ∂SSIM/∂(mean, mean square, mean product), zero where there is no window.
@group(0) @binding(5) var<storage, read_write> partials: array<vec4<f32>>;
// [tiles] sums of |colour error|, SSIM, |depth error|, squared colour error.
@group(0) @binding(6) var<storage, read_write> loss_sums: array<vec4<f32>>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

// Filtered along rows: [3 channels, 17 rows, 8 windows].
var<workgroup> rows: array<vec4<f32>, 408>;
var<workgroup> sums: array<vec4<f32>, 32>;

struct Ssim {
    value: vec3<f32>,
    by_mean: vec3<f32>,
    by_square: vec3<f32>,
    by_product: vec3<f32>,
}

// A workgroup covers a tile, 16×8 pixels, and an invocation one window and four pixels. Windows at pixels that were
// not recorded are perfect. Such pixels are zero in both images, as those beyond the border are.
@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let first = vec2(workgroup.x * 16u, workgroup.y * 8u);
    let tile = workgroup.y * workgroups.x + workgroup.x;
    let window = vec2(local % 8u, local / 8u);
    let stride = bordered_windows(setup.width);
    let plane = stride * bordered_windows(setup.height);
    let to = (first.y / 2u + window.y + WINDOW_BORDER) * stride + first.x / 2u + window.x + WINDOW_BORDER;
    for (var item = local; item < 34u; item += 32u) {
        filter_row(first, item / 2u, item % 2u * 4u);
    }
    workgroupBarrier();
    let at = window.y * 16u + window.x;
    let ssim = ssim_of(filter_column(at), filter_column(136u + at), filter_column(272u + at));
    let center = first + 2u * window + vec2(setup.phase_x, setup.phase_y);
    let is_inside = center.x < setup.width && center.y < setup.height;
    let is_recorded = target_color[select(0u, center.y * setup.width + center.x, is_inside)] != 0u;
    let weight = select(0.0, 1.0, is_inside && is_recorded);
    for (var channel = 0u; channel < 3u; channel++) {
        partials[channel * plane + to] = weight * vec4(ssim.by_mean[channel], ssim.by_square[channel], ssim.by_product[channel], 0.0);
    }
    var sum = vec4(0.0);
    let similarity = select(3.0, ssim.value.x + ssim.value.y + ssim.value.z, is_recorded);
    sum.y = select(0.0, setup.pixels_per_window * similarity, is_inside);
    // Four pixels of one column.
    let x = first.x + local % 16u;
    let y = first.y + local / 16u * 4u;
    for (var k = 0u; k < 4u; k++) {
        if x >= setup.width || y + k >= setup.height {
            continue;
        }
        let index = (y + k) * setup.width + x;
        let rendered = color_depth[index];
        let wanted = wanted_pixel(target_color[index]);
        let error = wanted.w * (rendered.xyz - wanted.xyz);
        let measured = target_depth[index];
        sum.x += abs(error.x) + abs(error.y) + abs(error.z);
        sum.w += dot(error, error);
        if setup.depth_weight > 0.0 && measured > 0.0 {
            sum.z += depth_precision(measured) * abs(rendered.w - (1.0 - state[index].x) * measured);
        }
    }
    sums[local] = sum;
    for (var half = 16u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half {
            sums[local] += sums[local + half];
        }
    }
    if local == 0u {
        loss_sums[tile] = sums[0];
    }
}

// What SSIM needs of a pixel; of the variances only their sum.
fn quantities(x: f32, y: f32) -> vec4<f32> {
    return vec4(x, y, x * x + y * y, x * y);
}

// Adds the pixel at (x, y), zero beyond the image.
fn add_pixel(
    x: i32,
    y: i32,
    red: ptr<function, Filtered>,
    green: ptr<function, Filtered>,
    blue: ptr<function, Filtered>,
    taps: vec4<f32>,
) {
    let inside = x >= 0 && y >= 0 && x < i32(setup.width) && y < i32(setup.height);
    let index = select(0u, u32(y) * setup.width + u32(x), inside);
    let wanted = select(vec4(0.0), wanted_pixel(target_color[index]), inside);
    let rendered = select(vec3(0.0), color_depth[index].xyz, wanted.w > 0.0);
    add(red, quantities(rendered.x, wanted.x), taps);
    add(green, quantities(rendered.y, wanted.y), taps);
    add(blue, quantities(rendered.z, wanted.z), taps);
}

// Four windows of one row of pixels, from window `column` on.
fn filter_row(first: vec2<u32>, row: u32, column: u32) {
    let x = i32(first.x + setup.phase_x + 2u * column) - i32(RADIUS);
    let y = i32(first.y + setup.phase_y + row) - i32(RADIUS);
    var red: Filtered;
    var green: Filtered;
    var blue: Filtered;
    add_pixel(x + 0, y, &red, &green, &blue, T0);
    add_pixel(x + 1, y, &red, &green, &blue, T1);
    add_pixel(x + 2, y, &red, &green, &blue, T2);
    add_pixel(x + 3, y, &red, &green, &blue, T3);
    add_pixel(x + 4, y, &red, &green, &blue, T4);
    add_pixel(x + 5, y, &red, &green, &blue, T5);
    add_pixel(x + 6, y, &red, &green, &blue, T6);
    add_pixel(x + 7, y, &red, &green, &blue, T7);
    add_pixel(x + 8, y, &red, &green, &blue, T8);
    add_pixel(x + 9, y, &red, &green, &blue, T9);
    add_pixel(x + 10, y, &red, &green, &blue, T10);
    add_pixel(x + 11, y, &red, &green, &blue, T11);
    add_pixel(x + 12, y, &red, &green, &blue, T12);
    add_pixel(x + 13, y, &red, &green, &blue, T13);
    add_pixel(x + 14, y, &red, &green, &blue, T14);
    add_pixel(x + 15, y, &red, &green, &blue, T15);
    add_pixel(x + 16, y, &red, &green, &blue, T16);
    let to = row * 8u + column;
    for (var k = 0u; k < 4u; k++) {
        rows[to + k] = red.at[k];
        rows[136u + to + k] = green.at[k];
        rows[272u + to + k] = blue.at[k];
    }
}

// A window of one channel, from the first of its rows on.
fn filter_column(at: u32) -> vec4<f32> {
    return W0 * (rows[at] + rows[at + 80u])
        + W1 * (rows[at + 8u] + rows[at + 72u])
        + W2 * (rows[at + 16u] + rows[at + 64u])
        + W3 * (rows[at + 24u] + rows[at + 56u])
        + W4 * (rows[at + 32u] + rows[at + 48u])
        + W5 * rows[at + 40u];
}

// Of the three channels, which are the lanes.
fn ssim_of(red: vec4<f32>, green: vec4<f32>, blue: vec4<f32>) -> Ssim {
    let mean_x = vec3(red.x, green.x, blue.x);
    let mean_y = vec3(red.y, green.y, blue.y);
    let squares = vec3(red.z, green.z, blue.z);
    let product = vec3(red.w, green.w, blue.w);
    // Rounding can make the sum of the variances negative; it is then a constant 0.
    let means = mean_x * mean_x + mean_y * mean_y;
    let variances = max(squares - means, vec3(0.0));
    let free = select(vec3(0.0), vec3(1.0), squares > means);
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
