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

// Exponent -½dᵀPd of a Gaussian at the quad's pixels.
fn exponent(mean: vec2<f32>, conic: vec3<f32>, quad: Quad) -> vec4<f32> {
    let dx = quad.x - mean.x;
    let dy = quad.y - mean.y;
    return -0.5 * (conic.x * dx * dx + conic.z * dy * dy) - conic.y * dx * dy;
}
