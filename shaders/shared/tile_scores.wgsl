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

// 1 where the error of a strip's pixel exceeds the threshold.
fn error_pixels(place: Place, strip: u32, threshold: f32) -> vec4<f32> {
    let errors = view.width * view.height + place.block.first + strip * view.width;
    var is_error = vec4(0.0);
    for (var p = 0u; p < 4u; p++) {
        if place.block.columns[p] && strip < place.block.rows && image_gradients[errors + p].y > threshold {
            is_error[p] = 1.0;
        }
    }
    return is_error;
}

// Takes a strip past one Gaussian as `add_gradient` does, and adds to its score.
fn add_score(gaussian: Listed, x: vec4<f32>, y: f32, is_error: vec4<f32>, pixels: ptr<function, PixelState>, sum: ptr<function, PairScore>) {
    let shape = gaussian.shape;
    let dy = y - gaussian.mean.y;
    let dx = x - gaussian.mean.x;
    let u = shape.x * dx + shape.y * dy;
    let v = shape.z * dy;
    let passed = pass_gaussian(gaussian, dx, dy, pixels);
    let weight = passed.weight;
    let by_x = 2.0 * passed.q * shape.x * u;
    let by_y = 2.0 * passed.q * (shape.y * u + shape.z * v);
    let ones = vec4(1.0);
    let blended = select(vec4(0.0), is_error, passed.hit);
    let largest = max(max(weight.x, weight.y), max(weight.z, weight.w));
    let before = (*sum).seen;
    (*sum).seen = vec4(before.x + dot(blended, ones), before.y + dot(weight, ones), max(before.z, largest), 0.0);
    (*sum).gradient += vec4(dot(by_x, ones), dot(by_y, ones), dot(abs(by_x), ones), dot(abs(by_y), ones));
}
