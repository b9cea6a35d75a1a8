// Photometric and depth loss of a rendered view, and what the backward pass needs of SSIM: its partial derivatives by the local mean,
// mean square and mean product. L = (1-λ)·L1 + λ·(1-SSIM) + λ_depth·p·|Σ w z - (1-T)·sensor depth|, p the sensor's precision there, means over the image.

@group(0) @binding(0) var<uniform> setup: LossSetup;
// [H, W] rendered (r, g, b, Σ w z); (bits of the transmittance, -).
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<u32>>;
// [H, W] the keyframe: 8-bit RGBA, all 0 where nothing was recorded, HIDDEN where it shows what is away; and sensor depth in metres (0: not measured).
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3 channels, bordered windows along y, along x] ∂SSIM/∂(mean, mean square, mean product), zero where there is no window.
@group(0) @binding(5) var<storage, read_write> partials: array<vec4<f32>>;
// [workgroups] sums of |colour error|, SSIM, |depth error|, squared colour error.
@group(0) @binding(6) var<storage, read_write> loss_sums: array<vec4<f32>>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

// One channel filtered along columns: [8 windows, 13 even columns, 13 odd ones], so that windows side by side read side by side.
var<workgroup> columns: array<vec4<f32>, 208>;
var<workgroup> sums: array<vec4<f32>, 64>;

struct Ssim {
    value: f32,
    by_mean: f32,
    by_square: f32,
    by_product: f32,
}

// A workgroup covers 16×16 pixels, and an invocation one window and four pixels. Windows at pixels that were not recorded are perfect. Such pixels are
// zero in both images, as those beyond the border are.
@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let first = workgroup.xy * 16u;
    let window = vec2(local % 8u, local / 8u);
    let stride = bordered_windows(setup.width);
    let plane = stride * bordered_windows(setup.height);
    let to = (first.y / 2u + window.y + WINDOW_BORDER) * stride + first.x / 2u + window.x + WINDOW_BORDER;
    let center = first + 2u * window + vec2(setup.phase_x, setup.phase_y);
    let is_inside = center.x < setup.width && center.y < setup.height;
    let is_seen = is_recorded(target_color[select(0u, center.y * setup.width + center.x, is_inside)]);
    let weight = select(0.0, 1.0, is_inside && is_seen);
    var sum = vec4(0.0);
    var red: Filtered;
    var green: Filtered;
    var blue: Filtered;
    if local < 50u {
        filter_column(first, local % 25u, local / 25u * 4u, &red, &green, &blue);
    }
    let at = window.y * 26u + window.x;
    let by_red = filter_rows(local, at, red);
    partials[to] = weight * vec4(by_red.by_mean, by_red.by_square, by_red.by_product, 0.0);
    let by_green = filter_rows(local, at, green);
    partials[plane + to] = weight * vec4(by_green.by_mean, by_green.by_square, by_green.by_product, 0.0);
    let by_blue = filter_rows(local, at, blue);
    partials[2u * plane + to] = weight * vec4(by_blue.by_mean, by_blue.by_square, by_blue.by_product, 0.0);
    let ssim = by_red.value + by_green.value + by_blue.value;
    sum.y = select(0.0, setup.pixels_per_window * select(3.0, ssim, is_seen), is_inside);
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
            sum.z += depth_precision(measured) * abs(rendered.w - (1.0 - bitcast<f32>(state[index].x)) * measured);
        }
    }
    sums[local] = sum;
    for (var half = 32u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half {
            sums[local] += sums[local + half];
        }
    }
    if local == 0u {
        loss_sums[workgroup.y * workgroups.x + workgroup.x] = sums[0];
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
    let packed = select(0u, target_color[index], inside);
    let rendered = select(vec3(0.0), color_depth[index].xyz, is_recorded(packed));
    let wanted = wanted_pixel(packed);
    add(red, quantities(rendered.x, wanted.x), taps);
    add(green, quantities(rendered.y, wanted.y), taps);
    add(blue, quantities(rendered.z, wanted.z), taps);
}

// Four windows of one column of pixels, from the row of windows `row` on. Side by side, invocations read side by side.
fn filter_column(
    first: vec2<u32>,
    column: u32,
    row: u32,
    red: ptr<function, Filtered>,
    green: ptr<function, Filtered>,
    blue: ptr<function, Filtered>,
) {
    let x = i32(first.x + setup.phase_x + column) - i32(RADIUS);
    let y = i32(first.y + setup.phase_y + 2u * row) - i32(RADIUS);
    add_pixel(x, y + 0, red, green, blue, T0);
    add_pixel(x, y + 1, red, green, blue, T1);
    add_pixel(x, y + 2, red, green, blue, T2);
    add_pixel(x, y + 3, red, green, blue, T3);
    add_pixel(x, y + 4, red, green, blue, T4);
    add_pixel(x, y + 5, red, green, blue, T5);
    add_pixel(x, y + 6, red, green, blue, T6);
    add_pixel(x, y + 7, red, green, blue, T7);
    add_pixel(x, y + 8, red, green, blue, T8);
    add_pixel(x, y + 9, red, green, blue, T9);
    add_pixel(x, y + 10, red, green, blue, T10);
    add_pixel(x, y + 11, red, green, blue, T11);
    add_pixel(x, y + 12, red, green, blue, T12);
    add_pixel(x, y + 13, red, green, blue, T13);
    add_pixel(x, y + 14, red, green, blue, T14);
    add_pixel(x, y + 15, red, green, blue, T15);
    add_pixel(x, y + 16, red, green, blue, T16);
}

// The windows of one channel, filtered along rows as well.
fn filter_rows(local: u32, at: u32, sum: Filtered) -> Ssim {
    workgroupBarrier();
    if local < 50u {
        let to = local % 25u % 2u * 13u + local % 25u / 2u + local / 25u * 104u;
        columns[to] = sum.a;
        columns[to + 26u] = sum.b;
        columns[to + 52u] = sum.c;
        columns[to + 78u] = sum.d;
    }
    workgroupBarrier();
    return ssim_of(filter_row(at));
}

// A window, of which `at` is the first column.
fn filter_row(at: u32) -> vec4<f32> {
    return W0 * (columns[at] + columns[at + 5u])
        + W1 * (columns[at + 13u] + columns[at + 17u])
        + W2 * (columns[at + 1u] + columns[at + 4u])
        + W3 * (columns[at + 14u] + columns[at + 16u])
        + W4 * (columns[at + 2u] + columns[at + 3u])
        + W5 * columns[at + 15u];
}

fn ssim_of(filtered: vec4<f32>) -> Ssim {
    let mean_x = filtered.x;
    let mean_y = filtered.y;
    let squares = filtered.z;
    let product = filtered.w;
    // Rounding can make the sum of the variances negative; it is then a constant 0.
    let means = mean_x * mean_x + mean_y * mean_y;
    let variances = max(squares - means, 0.0);
    let free = select(0.0, 1.0, squares > means);
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
