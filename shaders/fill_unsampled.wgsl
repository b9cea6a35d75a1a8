// Copies the recorded image, in the map's colours, into unsampled tiles: its neighbours' SSIM needs something to compare. One workgroup a tile.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> unsampled: UnsampledTiles;
@group(0) @binding(2) var<storage, read> target_color: array<u32>;
// [H, W] see `rasterize_forward`.
@group(0) @binding(3) var<storage, read_write> color_depth: array<vec4<f32>>;
@group(0) @binding(4) var<uniform> setup: LossSetup;

const THREADS: u32 = 32u;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup);
    if tile >= view.tiles_x * view.tiles_y || !is_bit_set(unsampled.bits[tile / 128u % 1024u], tile) {
        return;
    }
    let first = vec2(tile % view.tiles_x * TILE_WIDTH, tile / view.tiles_x * TILE_HEIGHT);
    for (var i = local; i < TILE_WIDTH * TILE_HEIGHT; i += THREADS) {
        let pixel = first + vec2(i % TILE_WIDTH, i / TILE_WIDTH);
        if pixel.x < view.width && pixel.y < view.height {
            let index = pixel.y * view.width + pixel.x;
            color_depth[index] = vec4(wanted_pixel(target_color[index]).xyz, 0.0);
        }
    }
}
