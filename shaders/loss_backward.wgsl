// Gradient of the loss with respect to the rendered image: filters the partials of SSIM (the window is symmetric, so its transpose
// is itself) and adds the L1 and depth terms.

struct LossSetup {
    width: u32,
    height: u32,
    ssim_weight: f32,
    depth_weight: f32,
}

@group(0) @binding(0) var<uniform> setup: LossSetup;
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
@group(0) @binding(5) var<storage, read> partials: array<vec4<f32>>;
// [2, H, W] plane 0 (r, g, b, Σ w z), plane 1 (alpha, -, -, -).
@group(0) @binding(6) var<storage, read_write> image_gradients: array<vec4<f32>>;

// (by mean, by square, by product) of one channel, and the same filtered along rows.
var<workgroup> source: array<vec3<f32>, 676>;

@compute @workgroup_size(16, 16)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_id) at: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let pixel = workgroup.xy * 16u + at.xy;
    let inside = pixel.x < setup.width && pixel.y < setup.height;
    let index = pixel.y * setup.width + pixel.x;
    let pixels = setup.width * setup.height;
    let per_pixel = 1.0 / f32(pixels);
    var rendered = vec4(0.0);
    var wanted = vec4(0.0);
    if inside {
        rendered = color_depth[index];
        wanted = unpack4x8unorm(target_color[index]);
    }
    var gradient = vec4(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        load_tile(workgroup.xy, channel, local, pixels);
        workgroupBarrier();
        let filtered = filter_tile(at.xy);
        let ssim = filtered.x + 2.0 * rendered[channel] * filtered.y + wanted[channel] * filtered.z;
        let l1 = sign(rendered[channel] - wanted[channel]);
        gradient[channel] = ((1.0 - setup.ssim_weight) * l1 - setup.ssim_weight * ssim) * per_pixel / 3.0;
    }
    if !inside {
        return;
    }
    var gradient_alpha = 0.0;
    let measured = target_depth[index];
    if setup.depth_weight > 0.0 && measured > 0.0 {
        let side = sign(rendered.w - (1.0 - state[index].x) * measured) * setup.depth_weight * per_pixel;
        gradient.w = side;
        gradient_alpha = -side * measured;
    }
    image_gradients[index] = gradient;
    image_gradients[pixels + index] = vec4(gradient_alpha, 0.0, 0.0, 0.0);
}

fn load_tile(workgroup: vec2<u32>, channel: u32, local: u32, pixels: u32) {
    for (var k = local; k < SPAN * SPAN; k += 256u) {
        let pixel = vec2<i32>(workgroup * 16u + vec2(k % SPAN, k / SPAN)) - i32(RADIUS);
        var value = vec3(0.0);
        if all(pixel >= vec2(0)) && pixel.x < i32(setup.width) && pixel.y < i32(setup.height) {
            let i = u32(pixel.y) * setup.width + u32(pixel.x);
            value = vec3(partials[i][channel], partials[pixels + i][channel], partials[2u * pixels + i][channel]);
        }
        source[k] = value;
    }
}

var<workgroup> rows: array<vec3<f32>, 416>;

fn filter_tile(at: vec2<u32>) -> vec3<f32> {
    let local = at.y * 16u + at.x;
    for (var k = local; k < 416u; k += 256u) {
        let first = (k / 16u) * SPAN + k % 16u;
        var sum = vec3(0.0);
        for (var tap = 0u; tap < 11u; tap++) {
            sum += WINDOW[tap] * source[first + tap];
        }
        rows[k] = sum;
    }
    workgroupBarrier();
    var sum = vec3(0.0);
    for (var tap = 0u; tap < 11u; tap++) {
        sum += WINDOW[tap] * rows[(at.y + tap) * 16u + at.x];
    }
    return sum;
}
