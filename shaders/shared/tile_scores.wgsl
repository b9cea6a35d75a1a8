// What each (Gaussian, tile) intersection does to the pixels that it was really blended into, written over the intersection's gradient, whose turn comes
// after: the raw material of density control (FastGS, arXiv 2511.04283; absolute gradients after AbsGS, arXiv 2404.10484).
//
// An error pixel is one whose error exceeds a multiple of the view's mean error, and the noise of the sensor: one hot pixel
// does not rescale the mask, and a view that is good already has few.

struct ScoreSetup {
    // Multiple of the mean absolute error above which a pixel is an error pixel; and the error below which none is.
    error_ratio: f32,
    noise: f32,
    ssim_weight: f32,
    pixels: f32,
}

@group(0) @binding(9) var<uniform> setup: ScoreSetup;
// (Σ|colour error|, Σ SSIM, -, -) over the view's pixels and channels.
@group(0) @binding(10) var<uniform> total: vec4<f32>;

// Of a intersection, over the pixels of its tile.
struct PairScore {
    // (error pixels, Σ w, largest w, 0), w what the Gaussian adds to a pixel.
    seen: vec4<f32>,
    // By the image mean, in pixels: (Σ ∂x, Σ ∂y, Σ|∂x|, Σ|∂y|).
    gradient: vec4<f32>,
}

// Mean absolute error above which a pixel is an error pixel.
fn error_threshold() -> f32 {
    return max(setup.noise, setup.error_ratio * total.x / (3.0 * setup.pixels));
}

// 1 where the error of a pixel exceeds the threshold.
fn error_pixel(pixel: u32, threshold: f32) -> f32 {
    return select(0.0, 1.0, image_gradients[view.width * view.height + pixel].y > threshold);
}

// Takes the pixels at columns `x` of row `y` past one Gaussian as `add_gradient` does, and adds to its score.
fn add_score(gaussian: Listed, x: Pixels, y: f32, is_error: Pixels, pixels: ptr<function, PixelState>, sum: ptr<function, PairScore>) {
    let shape = gaussian.shape;
    let dy = y - gaussian.mean.y;
    let dx = x - gaussian.mean.x;
    let u = shape.x * dx + shape.y * dy;
    let v = shape.z * dy;
    let passed = pass_gaussian(gaussian, dx, dy, pixels);
    let weight = passed.weight;
    let by_x = 2.0 * passed.q * shape.x * u;
    let by_y = 2.0 * passed.q * (shape.y * u + shape.z * v);
    let errors = sum_of(select(Pixels(0.0), is_error, passed.hit));
    let before = (*sum).seen;
    (*sum).seen = vec4(before.x + errors, before.y + sum_of(weight), max(before.z, largest_of(weight)), 0.0);
    (*sum).gradient += vec4(sum_of(by_x), sum_of(by_y), sum_of(abs(by_x)), sum_of(abs(by_y)));
}
