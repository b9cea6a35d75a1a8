// The same gradients as `rasterize_backward_narrow`: the sums of `shared/tile_sums`.

alias Sum = IntersectionGradient;
// Ten, and of a planar surface the two by its slopes.
const VALUES: u32 = 4u + 2u * PROJECTED;

fn no_sum() -> Sum {
    return IntersectionGradient(vec4(0.0), vec4(0.0), vec4(0.0));
}

fn begin(corner: vec2<u32>, lane: u32) {}

fn add_pixels(gaussian: Listed, x: f32, y: f32, subtile: u32, pixels: ptr<function, PixelState>, sum: ptr<function, Sum>) {
    add_gradient(gaussian, x, y, pixels, sum);
}

fn leave_sum(sum: Sum, to: u32) {
    partial[to] = sum.color_depth.x;
    partial[to + ROW] = sum.color_depth.y;
    partial[to + 2u * ROW] = sum.color_depth.z;
    partial[to + 3u * ROW] = sum.color_depth.w;
    partial[to + 4u * ROW] = sum.first.x;
    partial[to + 5u * ROW] = sum.first.y;
    partial[to + 6u * ROW] = sum.first.z;
    partial[to + 7u * ROW] = sum.second.x;
    partial[to + 8u * ROW] = sum.second.y;
    partial[to + 9u * ROW] = sum.second.z;
    //# planar
    partial[to + 10u * ROW] = sum.first.w;
    partial[to + 11u * ROW] = sum.second.w;
    //# end
}

fn joined(a: f32, b: f32, value: u32) -> f32 {
    return a + b;
}

// The gradient by a colour before its clamp at black.
fn whole(sum: f32, k: u32, value: u32) -> f32 {
    return select(sum, 0.0, value < 3u && !(batch_color[k][value % 4u] > 0.0));
}

// Behind the seventh value is that by the slope along x.
fn place_in_slot(value: u32) -> u32 {
    let moved = select(value, value + 1u, value > 6u);
    return select(moved, 4u * value - 33u, value > 9u);
}

// What is blended into a hidden pixel has a gradient beyond any other, by which `project_backward` knows it.
fn hidden_gradient(pixel: u32) -> f32 {
    return image_gradients[view.width * view.height + pixel].z;
}
