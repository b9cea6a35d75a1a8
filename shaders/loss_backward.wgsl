// Gradient of the loss with respect to the rendered image: filters the partials of SSIM (the window is symmetric, so its transpose
// is itself) and adds the L1 and depth terms.

@group(0) @binding(0) var<uniform> setup: LossSetup;
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
@group(0) @binding(5) var<storage, read> partials: array<vec4<f32>>;
// [2, H, W] plane 0 (r, g, b, Σ w z), plane 1 (alpha, -, -, -).
@group(0) @binding(6) var<storage, read_write> image_gradients: array<vec4<f32>>;

// (by mean, by square, by product) of one channel, and the same filtered along rows: [26 rows, 16 columns].
var<workgroup> source: array<vec3<f32>, 676>;
var<workgroup> rows: array<vec3<f32>, 416>;

// Filtered partials of four outputs.
struct Partials {
    by_mean: vec4<f32>,
    by_square: vec4<f32>,
    by_product: vec4<f32>,
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    // Four pixels of one column.
    let column = local % 16u;
    let row = local / 16u * 4u;
    let x = workgroup.x * 16u + column;
    let y = workgroup.y * 16u + row;
    let pixels = setup.width * setup.height;
    let per_pixel = 1.0 / f32(pixels);
    let end = select(0u, min(4u, setup.height - min(y, setup.height)), x < setup.width);
    var gradient: array<vec4<f32>, 4>;
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        load_tile(workgroup.xy, channel, local, pixels);
        workgroupBarrier();
        for (var item = local; item < SPAN * 4u; item += 64u) {
            filter_row(item / 4u, item % 4u * 4u);
        }
        workgroupBarrier();
        let filtered = filter_column(column, row);
        for (var k = 0u; k < end; k++) {
            let index = (y + k) * setup.width + x;
            let rendered = color_depth[index][channel];
            let wanted = unpack4x8unorm(target_color[index])[channel];
            let ssim = filtered.by_mean[k] + 2.0 * rendered * filtered.by_square[k] + wanted * filtered.by_product[k];
            let l1 = sign(rendered - wanted);
            gradient[k][channel] = ((1.0 - setup.ssim_weight) * l1 - setup.ssim_weight * ssim) * per_pixel / 3.0;
        }
    }
    for (var k = 0u; k < end; k++) {
        let index = (y + k) * setup.width + x;
        var gradient_alpha = 0.0;
        let measured = target_depth[index];
        if setup.depth_weight > 0.0 && measured > 0.0 {
            let residual = color_depth[index].w - (1.0 - state[index].x) * measured;
            gradient[k].w = sign(residual) * setup.depth_weight * per_pixel;
            gradient_alpha = -gradient[k].w * measured;
        }
        image_gradients[index] = gradient[k];
        image_gradients[pixels + index] = vec4(gradient_alpha, 0.0, 0.0, 0.0);
    }
}

fn load_tile(workgroup: vec2<u32>, channel: u32, local: u32, pixels: u32) {
    for (var k = local; k < SPAN * SPAN; k += 64u) {
        let pixel = vec2<i32>(workgroup * 16u + vec2(k % SPAN, k / SPAN)) - i32(RADIUS);
        var value = vec3(0.0);
        if all(pixel >= vec2(0)) && pixel.x < i32(setup.width) && pixel.y < i32(setup.height) {
            value = partials[channel * pixels + u32(pixel.y) * setup.width + u32(pixel.x)].xyz;
        }
        source[k] = value;
    }
}

fn add(sum: ptr<function, Partials>, value: vec3<f32>, taps: vec4<f32>) {
    (*sum).by_mean += taps * value.x;
    (*sum).by_square += taps * value.y;
    (*sum).by_product += taps * value.z;
}

fn filter_row(row: u32, first: u32) {
    let at = row * SPAN + first;
    var sum: Partials;
    add(&sum, source[at], T0);
    add(&sum, source[at + 1u], T1);
    add(&sum, source[at + 2u], T2);
    add(&sum, source[at + 3u], T3);
    add(&sum, source[at + 4u], T4);
    add(&sum, source[at + 5u], T5);
    add(&sum, source[at + 6u], T6);
    add(&sum, source[at + 7u], T7);
    add(&sum, source[at + 8u], T8);
    add(&sum, source[at + 9u], T9);
    add(&sum, source[at + 10u], T10);
    add(&sum, source[at + 11u], T11);
    add(&sum, source[at + 12u], T12);
    add(&sum, source[at + 13u], T13);
    for (var k = 0u; k < 4u; k++) {
        rows[row * 16u + first + k] = vec3(sum.by_mean[k], sum.by_square[k], sum.by_product[k]);
    }
}

fn filter_column(column: u32, first: u32) -> Partials {
    let at = first * 16u + column;
    var sum: Partials;
    add(&sum, rows[at], T0);
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
