// A tile's Gaussians and pixels, as the blending passes see them. A workgroup covers a tile: each invocation takes QUADS quads of 2×2
// pixels, a quad held as the lanes of a vec4, and the Gaussians pass in batches through workgroup memory.

@group(0) @binding(0) var<uniform> view: View;
// [tiles] (first pair, past the last) in the sorted list; [pairs] slot of each sorted pair; [pairs] Gaussian of each slot.
@group(0) @binding(1) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> slot_gaussians: array<u32>;
// [3, capacity], see `project_forward`.
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;

const TILE_QUADS: u32 = TILE_WIDTH * TILE_HEIGHT / 4u;
const TILE_THREADS: u32 = TILE_QUADS / QUADS;
// Gaussians held in workgroup memory at a time.
const BATCH: u32 = 64u;
var<workgroup> batch_mean: array<vec4<f32>, BATCH>;
var<workgroup> batch_whitening: array<vec4<f32>, BATCH>;
var<workgroup> batch_color: array<vec4<f32>, BATCH>;

struct Quad {
    x: vec4<f32>,
    y: vec4<f32>,
    // 1 where the pixel is on the image.
    inside: vec4<bool>,
    // Row-major pixel indices.
    index: vec4<u32>,
}

// Quad number `quad` of the tile's TILE_QUADS: four make a block of 4×4 pixels, and the blocks follow in rows.
fn quad_of(view_: View, tile: u32, quad: u32) -> Quad {
    let first = vec2((tile % view_.tiles_x) * TILE_WIDTH, (tile / view_.tiles_x) * TILE_HEIGHT);
    let block = vec2(quad / 4u % (TILE_WIDTH / 4u), quad / TILE_WIDTH);
    let corner = first + 4u * block + 2u * vec2(quad % 2u, quad / 2u % 2u);
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

fn load_batch(start: u32, end: u32, local: u32) {
    for (var k = local; k < min(BATCH, end - start); k += TILE_THREADS) {
        let gaussian = slot_gaussians[sorted_slots[start + k]];
        batch_mean[k] = projected[gaussian];
        batch_whitening[k] = projected[view.capacity + gaussian];
        batch_color[k] = projected[2u * view.capacity + gaussian];
    }
}
