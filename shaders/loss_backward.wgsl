// Gradient of the loss with respect to the rendered image: filters the partials of SSIM (the window is symmetric, so its transpose
// is itself) and adds the L1 and depth terms.

@group(0) @binding(0) var<uniform> setup: LossSetup;
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> target_color: array<u32>;
@group(0) @binding(4) var<storage, read> target_depth: array<f32>;
// [3 channels, bordered windows along y, along x], zero where there is no window.
@group(0) @binding(5) var<storage, read> partials: array<vec4<f32>>;
// [2, H, W] plane 0 (r, g, b, Σ w z), plane 1 (alpha; mean |colour error|, for the scores; HIDDEN_GRADIENT where the pixel is hidden; -).
@group(0) @binding(6) var<storage, read_write> image_gradients: array<vec4<f32>>;

// (by mean, by square, by product) of one channel filtered along rows: [13 rows of windows, 4 columns of each 4, of these the first, the second…].
var<workgroup> rows: array<vec4<f32>, 208>;

// A workgroup covers 16×16 pixels, and an invocation four of one column. What is computed of these lies side by side in a vector.
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let x = workgroup.x * 16u + local % 16u;
    let y = workgroup.y * 16u + local / 16u * 4u;
    let per_pixel = 1.0 / f32(setup.width * setup.height);
    // Beyond the image is the last pixel; nothing of it is stored.
    let at = min(vec4(y) + vec4(0u, 1u, 2u, 3u), vec4(setup.height - 1u)) * setup.width + min(x, setup.width - 1u);
    let rendered = transpose(mat4x4(color_depth[at.x], color_depth[at.y], color_depth[at.z], color_depth[at.w]));
    // A is 0 where nothing was recorded.
    let wanted = transpose(mat4x4(
        wanted_pixel(target_color[at.x]),
        wanted_pixel(target_color[at.y]),
        wanted_pixel(target_color[at.z]),
        wanted_pixel(target_color[at.w]),
    ));
    let measured = vec4(target_depth[at.x], target_depth[at.y], target_depth[at.z], target_depth[at.w]);
    let final_states = vec4(state[at.x].x, state[at.y].x, state[at.z].x, state[at.w].x);
    let residual = rendered[3] - (1.0 - bitcast<vec4<f32>>(final_states)) * measured;
    let trust = vec4(depth_precision(measured.x), depth_precision(measured.y), depth_precision(measured.z), depth_precision(measured.w));
    let is_measured = vec4(setup.depth_weight > 0.0) & (measured > vec4(0.0));
    let by_depth = select(vec4(0.0), sign(residual) * setup.depth_weight * trust * per_pixel, is_measured);
    let by_alpha = -by_depth * measured;
    let share = wanted[3] * per_pixel / 3.0;
    let gradient = transpose(mat4x4(
        share * by_channel(0u, workgroup.xy, local, rendered[0], wanted[0]),
        share * by_channel(1u, workgroup.xy, local, rendered[1], wanted[1]),
        share * by_channel(2u, workgroup.xy, local, rendered[2], wanted[2]),
        by_depth,
    ));
    let error = wanted[3] * (abs(rendered[0] - wanted[0]) + abs(rendered[1] - wanted[1]) + abs(rendered[2] - wanted[2])) / 3.0;
    store(x, y, gradient[0], by_alpha.x, error.x);
    store(x, y + 1u, gradient[1], by_alpha.y, error.y);
    store(x, y + 2u, gradient[2], by_alpha.z, error.z);
    store(x, y + 3u, gradient[3], by_alpha.w, error.w);
}

fn store(x: u32, y: u32, gradient: vec4<f32>, by_alpha: f32, error: f32) {
    if x < setup.width && y < setup.height {
        let at = y * setup.width + x;
        image_gradients[at] = gradient;
        let hidden = select(0.0, HIDDEN_GRADIENT, target_color[at] == HIDDEN);
        image_gradients[setup.width * setup.height + at] = vec4(by_alpha, error, hidden, 0.0);
    }
}

// Of one channel, what L1 and SSIM say of four pixels of a column.
fn by_channel(channel: u32, group: vec2<u32>, local: u32, rendered: vec4<f32>, wanted: vec4<f32>) -> vec4<f32> {
    let stride = bordered_windows(setup.width);
    // The first windows that reach the first pixels.
    let corner = group * 8u + 1u - vec2(setup.phase_x, setup.phase_y);
    workgroupBarrier();
    if local < 52u {
        let begin = (channel * bordered_windows(setup.height) + corner.y + local / 4u) * stride + corner.x + local % 4u * 2u;
        filter_row(begin, local / 4u * 16u + local % 4u);
    }
    workgroupBarrier();
    let filtered = filter_column(local / 16u * 32u + local % 4u * 4u + local % 16u / 4u);
    let by_mean = vec4(filtered.a.x, filtered.b.x, filtered.c.x, filtered.d.x);
    let by_square = vec4(filtered.a.y, filtered.b.y, filtered.c.y, filtered.d.y);
    let by_product = vec4(filtered.a.z, filtered.b.z, filtered.c.z, filtered.d.z);
    let ssim = by_mean + 2.0 * rendered * by_square + wanted * by_product;
    return (1.0 - setup.ssim_weight) * sign(rendered - wanted) - setup.ssim_weight * setup.pixels_per_window * ssim;
}

// Four pixels of a row, from the windows at `at` on, to `rows[to]`, and each fourth one on.
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
    rows[to] = sum.a;
    rows[to + 4u] = sum.b;
    rows[to + 8u] = sum.c;
    rows[to + 12u] = sum.d;
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
