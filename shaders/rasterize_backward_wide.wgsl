// The same gradients as `rasterize_backward_narrow`: the sum of `shared/tile_stream`.

var<private> sum: IntersectionGradient;

fn load_strip(place: Place, local: u32) {}

fn begin_sum() {
    sum = IntersectionGradient(vec4(0.0), vec4(0.0), vec4(0.0));
}

fn add_strip(gaussian: Listed, x: vec4<f32>, y: f32, strip: u32, pixels: ptr<function, PixelState>) {
    var grown = sum;
    add_gradient(gaussian, x, y, pixels, &grown);
    sum = grown;
}

fn store_sum(slot: u32, color: vec4<f32>) {
    intersection_gradients[slot * 3u] = before_clamp(color, sum.color_depth);
    intersection_gradients[slot * 3u + 1u] = sum.first;
    intersection_gradients[slot * 3u + 2u] = sum.second;
}

fn clear_sum(slot: u32) {
    intersection_gradients[slot * 3u] = vec4(0.0);
    intersection_gradients[slot * 3u + 1u] = vec4(0.0);
    intersection_gradients[slot * 3u + 2u] = vec4(0.0);
}
