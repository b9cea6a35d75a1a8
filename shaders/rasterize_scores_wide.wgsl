// The scores of `shared/tile_scores`: the sums of `shared/tile_sums`.

alias Sum = PairScore;
const VALUES: u32 = 7u;
const LARGEST: u32 = 2u;

// A bit for each sub-tile whose pixel is an error pixel.
var<private> errors: u32;

fn no_sum() -> Sum {
    return PairScore(vec4(0.0), vec4(0.0));
}

fn begin(corner: vec2<u32>, lane: u32) {
    let threshold = error_threshold();
    errors = 0u;
    for (var s = 0u; s < SUBTILES; s++) {
        let pixel = pixel_of(corner, s, lane);
        if is_on_image(pixel) {
            errors |= u32(error_pixel(pixel.y * view.width + pixel.x, threshold)) << s;
        }
    }
}

fn add_pixels(gaussian: Listed, x: f32, y: f32, subtile: u32, pixels: ptr<function, PixelState>, sum: ptr<function, Sum>) {
    add_score(gaussian, x, y, f32((errors >> subtile) & 1u), pixels, sum);
}

fn leave_sum(sum: Sum, to: u32) {
    partial[to] = sum.seen.x;
    partial[to + ROW] = sum.seen.y;
    partial[to + LARGEST * ROW] = sum.seen.z;
    partial[to + 3u * ROW] = sum.gradient.x;
    partial[to + 4u * ROW] = sum.gradient.y;
    partial[to + 5u * ROW] = sum.gradient.z;
    partial[to + 6u * ROW] = sum.gradient.w;
}

fn joined(a: f32, b: f32, value: u32) -> f32 {
    return select(a + b, max(a, b), value == LARGEST);
}

fn whole(sum: f32, k: u32, value: u32) -> f32 {
    return sum;
}

fn place_in_slot(value: u32) -> u32 {
    return select(value, value + 1u, value > LARGEST);
}

fn hidden_gradient(pixel: u32) -> f32 {
    return 0.0;
}
