// What both forms of the blending's backward pass share: the pixels' state and what one Gaussian does to it.
//
// Front to back, as the forward pass goes: with w = αT, v·g = colour·g_colour + depth·g_depth and R the share of the pixel's value
// behind the Gaussian, ∂L/∂α = T(v·g) - R/(1-α). T is never recovered by division. Of a planar surface, v has the slopes and the squared depth as well.

// [IMAGE_PLANES, H, W] rendered, see `shared/blend`, and [H, W] (bits of the transmittance, last).
@group(0) @binding(5) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> state: array<vec2<u32>>;
// [1 + IMAGE_PLANES, H, W] gradients of the loss: plane 0 (r, g, b, Σ w z), plane 1 (alpha, |error|, HIDDEN_GRADIENT or 0, -), plane 2 (Σ w slope x, Σ w slope y, Σ w z², -).
@group(0) @binding(7) var<storage, read> image_gradients: array<vec4<f32>>;

struct PixelState {
    transmittance: Pixels,
    // Pixel value behind the current Gaussian, dotted with the gradient.
    behind: Pixels,
    // How many Gaussians of the tile's list were blended.
    last: Counts,
    // Gradient of the loss.
    red: Pixels,
    green: Pixels,
    blue: Pixels,
    depth: Pixels,
    //# planar
    slope_x: Pixels,
    slope_y: Pixels,
    squared_depth: Pixels,
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

// What lies behind the first Gaussian of a pixel: everything blended, the background (it is in the rendered colour) and, as alpha is 1 - T, its gradient.
fn behind_all(pixel: u32) -> f32 {
    let gradient_alpha = image_gradients[view.width * view.height + pixel].x;
    var behind = dot(color_depth[pixel], image_gradients[pixel]) - bitcast<f32>(state[pixel].x) * gradient_alpha;
    //# planar
    let by_surface = image_gradients[2u * view.width * view.height + pixel];
    behind += dot(color_depth[view.width * view.height + pixel].xyz, by_surface.xyz);
    //# end
    return behind;
}

// What one Gaussian does to pixels.
struct Passed {
    weight: Pixels,
    // ∂L/∂log α.
    q: Pixels,
    hit: Flags,
    // ∂L/∂(its depth there), over the weight.
    by_depth: Pixels,
}

// Takes pixels past one Gaussian, which lies (dx, dy) before them in the image.
fn pass_gaussian(gaussian: Listed, dx: Pixels, dy: f32, pixels: ptr<function, PixelState>) -> Passed {
    let color = gaussian.color;
    let u = gaussian.shape.x * dx + gaussian.shape.y * dy;
    let v = gaussian.shape.z * dy;
    let distance = u * u + v * v;
    let hit = (distance <= Pixels(gaussian.mean.w)) & (Counts(gaussian.position) < (*pixels).last);
    let unbounded = gaussian.shape.w * exp(-distance);
    let alpha = select(Pixels(0.0), min(Pixels(ALPHA_MAX), unbounded), hit);
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
    return Passed(weight, select(Pixels(0.0), gradient_alpha * alpha, hit & (unbounded <= Pixels(ALPHA_MAX))), hit, by_depth);
}

// Takes the pixels at columns `x` of row `y` past one Gaussian, and adds to its gradient.
fn add_gradient(gaussian: Listed, x: Pixels, y: f32, pixels: ptr<function, PixelState>, sum: ptr<function, IntersectionGradient>) {
    let dx = x - gaussian.mean.x;
    let dy = y - gaussian.mean.y;
    let passed = pass_gaussian(gaussian, dx, dy, pixels);
    let weight = passed.weight;
    let q = sum_of(passed.q);
    let qx = sum_of_products(passed.q, dx);
    let by_depth = sum_of_products(weight, passed.by_depth);
    var by_slope = vec2(0.0);
    //# planar
    let by_slope_x = sum_of_products(weight, passed.by_depth * dx + (*pixels).slope_x);
    by_slope = vec2(by_slope_x, by_depth * dy + sum_of_products(weight, (*pixels).slope_y));
    //# end
    let red = sum_of_products(weight, (*pixels).red);
    let green = sum_of_products(weight, (*pixels).green);
    let blue = sum_of_products(weight, (*pixels).blue);
    (*sum).color_depth += vec4(red, green, blue, by_depth);
    (*sum).first += vec4(q, qx, q * dy, by_slope.x);
    (*sum).second += vec4(sum_of_products(passed.q, dx * dx), qx * dy, q * dy * dy, by_slope.y);
}
