// How a workgroup covers a tile: each invocation takes a 2×2 quad of pixels, held as the lanes of a vec4.
const TILE_THREADS: u32 = TILE_WIDTH * TILE_HEIGHT / 4u;
// Gaussians held in workgroup memory at a time.
const BATCH: u32 = 64u;

struct Quad {
    x: vec4<f32>,
    y: vec4<f32>,
    // 1 where the pixel is on the image.
    inside: vec4<bool>,
    // Row-major pixel indices.
    index: vec4<u32>,
}

fn quad_of(view_: View, tile: u32, local: u32) -> Quad {
    let first = vec2((tile % view_.tiles_x) * TILE_WIDTH, (tile / view_.tiles_x) * TILE_HEIGHT);
    let quads = TILE_WIDTH / 2u;
    let corner = first + 2u * vec2(local % quads, local / quads);
    let x = vec4(corner.x, corner.x + 1u, corner.x, corner.x + 1u);
    let y = vec4(corner.y, corner.y, corner.y + 1u, corner.y + 1u);
    let inside = (x < vec4(view_.width)) & (y < vec4(view_.height));
    return Quad(vec4<f32>(x), vec4<f32>(y), inside, y * view_.width + x);
}

// ½dᵀΣ⁻¹d of a Gaussian at the quad's pixels: alpha is opacity·exp(-that).
fn half_distance(mean: vec2<f32>, whitening: vec3<f32>, quad: Quad) -> vec4<f32> {
    let dy = quad.y - mean.y;
    let u = whitening.x * (quad.x - mean.x) + whitening.y * dy;
    let v = whitening.z * dy;
    return u * u + v * v;
}
