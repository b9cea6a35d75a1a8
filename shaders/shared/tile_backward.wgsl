// What both forms of the blending's backward pass share: the pixels' state and what one Gaussian does to it.
//
// Front to back, as the forward pass goes: with w = αT, v·g = colour·g_colour + depth·g_depth and R the share of the pixel's value
// behind the Gaussian, ∂L/∂α = T(v·g) - R/(1-α). T is never recovered by division. Of a planar surface, v has the slopes and the squared depth as well.

// [IMAGE_PLANES, H, W] rendered, see `rasterize_forward`, and [H, W] (bits of the transmittance, last).
@group(0) @binding(5) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> state: array<vec2<u32>>;
// [1 + IMAGE_PLANES, H, W] gradients of the loss: plane 0 (r, g, b, Σ w z), plane 1 (alpha, |error|, -, -), plane 2 (Σ w slope x, Σ w slope y, Σ w z², -).
@group(0) @binding(7) var<storage, read> image_gradients: array<vec4<f32>>;
// [intersections, 3] see `IntersectionGradient`.
@group(0) @binding(8) var<storage, read_write> intersection_gradients: array<vec4<f32>>;

// How many Gaussians of each tile's list were blended, and the most of these.
var<workgroup> tile_last: array<atomic<u32>, GROUP_TILES>;
var<workgroup> longest: atomic<u32>;

// A strip of pixels, in its lanes.
struct PixelState {
    transmittance: vec4<f32>,
    // Pixel value behind the current Gaussian, dotted with the gradient.
    behind: vec4<f32>,
    last: vec4<u32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
    //# planar
    slope_x: vec4<f32>,
    slope_y: vec4<f32>,
    squared_depth: vec4<f32>,
    //# end
}

// Gradient of a intersection, q = ∂L/∂log α.
struct IntersectionGradient {
    // (Σ w g_rgb, Σ w g_depth); without the channels that are clamped at black.
    color_depth: vec4<f32>,
    // (Σ q, Σ q dx, Σ q dy, by the slope along x)
    first: vec4<f32>,
    // (Σ q dx², Σ q dx dy, Σ q dy², by the slope along y)
    second: vec4<f32>,
}

// A strip's pixels; counts them in `tile_last` and `longest`.
fn load_pixels(place: Place, strip: u32) -> PixelState {
    var pixels: PixelState;
    pixels.transmittance = vec4(1.0);
    for (var p = 0u; p < 4u; p++) {
        if !place.block.columns[p] || strip >= place.block.rows {
            continue;
        }
        let i = place.block.first + strip * view.width + p;
        let gradient = image_gradients[i];
        let gradient_alpha = image_gradients[view.width * view.height + i].x;
        let final_state = state[i];
        let rendered = color_depth[i];
        pixels.red[p] = gradient.x;
        pixels.green[p] = gradient.y;
        pixels.blue[p] = gradient.z;
        pixels.depth[p] = gradient.w;
        pixels.last[p] = final_state.y;
        // Behind the first Gaussian lies everything blended, the background (it is in `rendered`) and, as alpha is 1 - T, its gradient.
        pixels.behind[p] = dot(rendered, gradient) - bitcast<f32>(final_state.x) * gradient_alpha;
        //# planar
        let by_surface = image_gradients[2u * view.width * view.height + i];
        pixels.slope_x[p] = by_surface.x;
        pixels.slope_y[p] = by_surface.y;
        pixels.squared_depth[p] = by_surface.z;
        pixels.behind[p] += dot(color_depth[view.width * view.height + i].xyz, by_surface.xyz);
        //# end
    }
    let last = max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w));
    atomicMax(&tile_last[place.member], last);
    atomicMax(&longest, last);
    return pixels;
}

// A Gaussian of a tile's list: see `project_forward`, and its place in the list.
struct Listed {
    mean: vec4<f32>,
    shape: vec4<f32>,
    color: vec4<f32>,
    position: u32,
    //# planar
    slope: vec2<f32>,
    //# end
}

// The one at a place of the batch.
fn listed(at: u32, position: u32) -> Listed {
    var gaussian: Listed;
    gaussian.mean = batch_mean[at];
    gaussian.shape = batch_conic_factor[at];
    gaussian.color = batch_color[at];
    gaussian.position = position;
    //# planar
    gaussian.slope = batch_slope[at];
    //# end
    return gaussian;
}

// What one Gaussian does to a strip.
struct Passed {
    weight: vec4<f32>,
    // ∂L/∂log α.
    q: vec4<f32>,
    hit: vec4<bool>,
    // ∂L/∂(its depth there), over the weight.
    by_depth: vec4<f32>,
}

// Takes a strip past one Gaussian, which lies (dx, dy) before it in the image.
fn pass_gaussian(gaussian: Listed, dx: vec4<f32>, dy: f32, pixels: ptr<function, PixelState>) -> Passed {
    let color = gaussian.color;
    let u = gaussian.shape.x * dx + gaussian.shape.y * dy;
    let v = gaussian.shape.z * dy;
    let distance = u * u + v * v;
    let hit = (distance <= vec4(gaussian.mean.w)) & (vec4(gaussian.position) < (*pixels).last);
    let unbounded = gaussian.shape.w * exp(-distance);
    let alpha = select(vec4(0.0), min(vec4(ALPHA_MAX), unbounded), hit);
    var value = (*pixels).red * color.x + (*pixels).green * color.y + (*pixels).blue * color.z + (*pixels).depth * gaussian.mean.z;
    var by_depth = (*pixels).depth;
    //# planar
    let beyond = gaussian.slope.x * dx + gaussian.slope.y * dy;
    let depth = gaussian.mean.z + beyond;
    value += (*pixels).depth * beyond + (*pixels).squared_depth * depth * depth;
    value += (*pixels).slope_x * gaussian.slope.x + (*pixels).slope_y * gaussian.slope.y;
    by_depth += 2.0 * (*pixels).squared_depth * depth;
    //# end
    let weight = alpha * (*pixels).transmittance;
    (*pixels).behind -= weight * value;
    let gradient_alpha = (*pixels).transmittance * value - (*pixels).behind / (1.0 - alpha);
    (*pixels).transmittance *= 1.0 - alpha;
    // Above the cap alpha no longer depends on shape and opacity.
    return Passed(weight, select(vec4(0.0), gradient_alpha * alpha, hit & (unbounded <= vec4(ALPHA_MAX))), hit, by_depth);
}

// Takes the strip at columns `x` of row `y` past one Gaussian, and adds to its gradient.
fn add_gradient(gaussian: Listed, x: vec4<f32>, y: f32, pixels: ptr<function, PixelState>, sum: ptr<function, IntersectionGradient>) {
    let dx = x - gaussian.mean.x;
    let dy = y - gaussian.mean.y;
    let passed = pass_gaussian(gaussian, dx, dy, pixels);
    let weight = passed.weight;
    let q = dot(passed.q, vec4(1.0));
    let qx = dot(passed.q, dx);
    let by_depth = dot(weight, passed.by_depth);
    var by_slope = vec2(0.0);
    //# planar
    by_slope = vec2(dot(weight, passed.by_depth * dx + (*pixels).slope_x), by_depth * dy + dot(weight, (*pixels).slope_y));
    //# end
    (*sum).color_depth += vec4(dot(weight, (*pixels).red), dot(weight, (*pixels).green), dot(weight, (*pixels).blue), by_depth);
    (*sum).first += vec4(q, qx, q * dy, by_slope.x);
    (*sum).second += vec4(dot(passed.q, dx * dx), qx * dy, q * dy * dy, by_slope.y);
}

// The gradient by a colour before its clamp at black.
fn before_clamp(color: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    return select(vec4(0.0), gradient, vec4(color.xyz > vec3(0.0), true));
}

// Before the pixels are loaded: workgroup memory holds anything.
fn clear_last(local: u32) {
    if local < GROUP_TILES {
        atomicStore(&tile_last[local], 0u);
    }
    if local == 0u {
        atomicStore(&longest, 0u);
    }
    workgroupBarrier();
}
