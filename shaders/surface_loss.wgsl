// Adds the terms of a planar surface to the image's gradients: its normals are those of its depth (2DGS, Huang et al. 2024), and what is blended into a pixel
// lies at one depth.
//
// L = λ_n·(1 - cos(n, N)) + λ_d·(Q·A/S² - 1), means over the pixels. A pixel's plane has the normal n ∝ (-f·g, z + r·f·g), r its ray, g the slope of its depth z:
// n that of the blended slopes, N that of the depths of the pixels beside it. S = Σ w z, Q = Σ w z², A = Σ w: the spread's term is a variance over a square.

// Host twin: `render::layout::SurfaceSetup`.
struct SurfaceSetup {
    // λ_n and λ_d, times the inverse number of pixels.
    normal_weight: f32,
    spread_weight: f32,
    // A pixel that is covered less has no surface.
    min_alpha: f32,
    // Neighbours whose depths differ by more than this share lie on different surfaces.
    edge: f32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> setup: SurfaceSetup;
// [2, H, W] rendered, see `rasterize_forward`, and (bits of the transmittance, -).
@group(0) @binding(2) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> state: array<vec2<u32>>;
// [3, H, W], see `tile_backward`.
@group(0) @binding(4) var<storage, read_write> image_gradients: array<vec4<f32>>;

// Gradient of the normals' term.
struct NormalGradient {
    // By the slopes' sums, and by S, through the blended normal.
    by_slopes: vec2<f32>,
    by_sum: f32,
    // By the difference of the depths on both sides along x and along y, and by the depth itself, through the normal of the depths.
    by_differences: vec2<f32>,
    by_depth: f32,
}

fn alpha_at(pixel: u32) -> f32 {
    return 1.0 - bitcast<f32>(state[pixel].x);
}

// Depth of a pixel's surface, metres; 0 where there is none.
fn depth_at(pixel: u32) -> f32 {
    let alpha = alpha_at(pixel);
    return select(0.0, max(color_depth[pixel].w, 0.0) / alpha, alpha >= setup.min_alpha);
}

// (-f·g, z + r·f·g)
fn normal_of(slope: vec2<f32>, depth: f32, ray: vec2<f32>) -> vec3<f32> {
    let scaled = view.intrinsics.xy * slope;
    return vec3(-scaled, depth + dot(ray, scaled));
}

// Its transpose: by the slope, and by the depth.
fn slope_gradient(by: vec3<f32>, ray: vec2<f32>) -> vec3<f32> {
    return vec3(view.intrinsics.xy * (by.z * ray - by.xy), by.z);
}

// The term of the pixel (x, y); zero where it or a neighbour has no surface, or lies on another one.
fn normal_gradient(x: u32, y: u32) -> NormalGradient {
    var out: NormalGradient;
    if x - 1u >= max(view.width, 2u) - 2u || y - 1u >= max(view.height, 2u) - 2u {
        return out;
    }
    let i = y * view.width + x;
    let depth = depth_at(i);
    let sides = vec4(depth_at(i - 1u), depth_at(i + 1u), depth_at(i - view.width), depth_at(i + view.width));
    // Without a surface, a side's depth is 0.
    if !(depth > 0.0 && all(abs(sides - depth) < vec4(setup.edge * depth))) {
        return out;
    }
    let ray = (vec2(f32(x), f32(y)) - view.intrinsics.zw) / view.intrinsics.xy;
    let sum = color_depth[i].w;
    let blended = normal_of(color_depth[view.width * view.height + i].xy, sum, ray);
    let of_depths = normal_of(0.5 * (sides.yw - sides.xz), depth, ray);
    let lengths = vec2(length(blended), length(of_depths));
    if !(lengths.x > 0.0 && lengths.y > 0.0) {
        return out;
    }
    let a = blended / lengths.x;
    let b = of_depths / lengths.y;
    let cosine = dot(a, b);
    let by_blended = slope_gradient(-setup.normal_weight * (b - cosine * a) / lengths.x, ray);
    let by_of_depths = slope_gradient(-setup.normal_weight * (a - cosine * b) / lengths.y, ray);
    out.by_slopes = by_blended.xy;
    out.by_sum = by_blended.z;
    out.by_differences = 0.5 * by_of_depths.xy;
    out.by_depth = by_of_depths.z;
    return out;
}

@compute @workgroup_size(16, 16)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= view.width || id.y >= view.height {
        return;
    }
    let pixels = view.width * view.height;
    let i = id.y * view.width + id.x;
    let own = normal_gradient(id.x, id.y);
    // Beyond the border the places wrap, and have no term.
    let by_depth = own.by_depth
        + normal_gradient(id.x - 1u, id.y).by_differences.x - normal_gradient(id.x + 1u, id.y).by_differences.x
        + normal_gradient(id.x, id.y - 1u).by_differences.y - normal_gradient(id.x, id.y + 1u).by_differences.y;
    let alpha = alpha_at(i);
    let depth = depth_at(i);
    var by_sum = own.by_sum;
    var by_alpha = 0.0;
    var by_squares = 0.0;
    if depth > 0.0 {
        by_sum += by_depth / alpha;
        by_alpha -= by_depth * depth / alpha;
        let sum = color_depth[i].w;
        let squares = color_depth[pixels + i].z;
        let weight = setup.spread_weight / (sum * sum);
        by_squares = weight * alpha;
        by_alpha += weight * squares;
        by_sum -= 2.0 * weight * squares * alpha / sum;
    }
    image_gradients[i].w += by_sum;
    image_gradients[pixels + i].x += by_alpha;
    image_gradients[2u * pixels + i] = vec4(own.by_slopes, by_squares, 0.0);
}
