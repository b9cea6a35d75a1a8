// The scores of `shared/tile_scores`: the sum of `shared/tile_stream`.

// Of each strip, a bit for each error pixel.
var<workgroup> strip_errors: array<u32, TILE_THREADS>;

var<private> sum: PairScore;

fn load_strip(place: Place, local: u32) {
    let is_error = error_pixels(place, 0u, error_threshold());
    strip_errors[local] = u32(dot(is_error, vec4(1.0, 2.0, 4.0, 8.0)));
}

fn begin_sum() {
    sum = PairScore(vec4(0.0), vec4(0.0));
}

fn add_strip(gaussian: Listed, x: vec4<f32>, y: f32, strip: u32, pixels: ptr<function, PixelState>) {
    let is_error = select(vec4(0.0), vec4(1.0), (vec4(strip_errors[strip]) & vec4(1u, 2u, 4u, 8u)) != vec4(0u));
    var grown = sum;
    add_score(gaussian, x, y, is_error, pixels, &grown);
    sum = grown;
}

fn store_sum(slot: u32, color: vec4<f32>) {
    intersection_gradients[slot * 3u] = sum.seen;
    intersection_gradients[slot * 3u + 1u] = sum.gradient;
}

fn clear_sum(slot: u32) {
    intersection_gradients[slot * 3u] = vec4(0.0);
    intersection_gradients[slot * 3u + 1u] = vec4(0.0);
}
