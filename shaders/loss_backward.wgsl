// Gradient of the loss with respect to the rendered image: filters the partials of SSIM (the window is symmetric, so its transpose
// is itself) and adds the L1 and depth terms.

@group(0) @binding(0) var<uniform> setup: LossSetup;
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3 channels, bordered windows along y, along x], zero where there is no window.
@group(0) @binding(5) var<storage, read> partials: array<vec4<f32>>;
// [2, H, W] plane 0 (r, g, b, Σ w z), plane 1 (alpha; mean |colour error|, for the scores; -, -).
@group(0) @binding(6) var<storage, read_write> image_gradients: array<vec4<f32>>;

// (by mean, by square, by product) of one channel filtered along rows: [13 rows of windows, 16 columns].
var<workgroup> rows: array<vec4<f32>, 208>;

// A workgroup covers 16×16 pixels.
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
    var rendered: array<vec4<f32>, 4>;
    var wanted: array<vec4<f32>, 4>;
    for (var k = 0u; k < end; k++) {
        rendered[k] = color_depth[(y + k) * setup.width + x];
        // A is 0 where nothing was recorded.
        wanted[k] = wanted_pixel(target_color[(y + k) * setup.width + x]);
    }
    for (var channel = 0u; channel < 3u; channel++) {
        let stride = bordered_windows(setup.width);
        // The first windows that reach the first pixels.
        let corner = vec2(workgroup.x * 8u + 1u - setup.phase_x, workgroup.y * 8u + 1u - setup.phase_y);
        workgroupBarrier();
        if local < 52u {
            let begin = (channel * bordered_windows(setup.height) + corner.y + local / 4u) * stride + corner.x + local % 4u * 2u;
            filter_row(begin, local * 4u);
        }
        workgroupBarrier();
        let filtered = filter_column(local / 16u * 32u + column);
        for (var k = 0u; k < end; k++) {
            let ssim = dot(filtered.at[k].xyz, vec3(1.0, 2.0 * rendered[k][channel], wanted[k][channel]));
            let l1 = sign(rendered[k][channel] - wanted[k][channel]);
            let by_color = (1.0 - setup.ssim_weight) * l1 - setup.ssim_weight * setup.pixels_per_window * ssim;
            gradient[k][channel] = wanted[k].w * by_color * per_pixel / 3.0;
        }
    }
    for (var k = 0u; k < end; k++) {
        let index = (y + k) * setup.width + x;
        var gradient_alpha = 0.0;
        let measured = target_depth[index];
        if setup.depth_weight > 0.0 && measured > 0.0 {
            let residual = rendered[k].w - (1.0 - bitcast<f32>(state[index].x)) * measured;
            gradient[k].w = sign(residual) * setup.depth_weight * depth_precision(measured) * per_pixel;
            gradient_alpha = -gradient[k].w * measured;
        }
        image_gradients[index] = gradient[k];
        let error = wanted[k].w * abs(rendered[k].xyz - wanted[k].xyz);
        image_gradients[pixels + index] = vec4(gradient_alpha, (error.x + error.y + error.z) / 3.0, 0.0, 0.0);
    }
}

// Four pixels of a row, from the windows at `at` on, to `rows[to]` on.
fn filter_row(at: u32, to: u32) {
    var sum: Filtered;
    if setup.phase_x == 0u {
        add(&sum, partials[at + 0u], E0);
        add(&sum, partials[at + 1u], E1);
        add(&sum, partials[at + 2u], E2);
        add(&sum, partials[at + 3u], E3);
        add(&sum, partials[at + 4u], E4);
        add(&sum, partials[at + 5u], E5);
        add(&sum, partials[at + 6u], E6);
    } else {
        add(&sum, partials[at + 0u], O0);
        add(&sum, partials[at + 1u], O1);
        add(&sum, partials[at + 2u], O2);
        add(&sum, partials[at + 3u], O3);
        add(&sum, partials[at + 4u], O4);
        add(&sum, partials[at + 5u], O5);
        add(&sum, partials[at + 6u], O6);
    }
    for (var k = 0u; k < 4u; k++) {
        rows[to + k] = sum.at[k];
    }
}

// Four pixels of a column, from the row of windows at `at` on.
fn filter_column(at: u32) -> Filtered {
    var sum: Filtered;
    if setup.phase_y == 0u {
        add(&sum, rows[at + 0u], E0);
        add(&sum, rows[at + 16u], E1);
        add(&sum, rows[at + 32u], E2);
        add(&sum, rows[at + 48u], E3);
        add(&sum, rows[at + 64u], E4);
        add(&sum, rows[at + 80u], E5);
        add(&sum, rows[at + 96u], E6);
    } else {
        add(&sum, rows[at + 0u], O0);
        add(&sum, rows[at + 16u], O1);
        add(&sum, rows[at + 32u], O2);
        add(&sum, rows[at + 48u], O3);
        add(&sum, rows[at + 64u], O4);
        add(&sum, rows[at + 80u], O5);
        add(&sum, rows[at + 96u], O6);
    }
    return sum;
}
