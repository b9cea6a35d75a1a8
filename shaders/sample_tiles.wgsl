// Draws the tiles of a keyframe that a step samples: in proportion to their loss, by what it was when each was last sampled.
// Every tile is sampled now and then, so that changes there are seen. One workgroup.

// Host twin: `render::layout::TileSamplingSetup`.
struct TileSamplingSetup {
    // Share of the steps that sample a tile of mean loss; other tiles in proportion to their loss.
    share: f32,
    // Least share of the steps that sample a tile.
    min_share: f32,
    // Loss per pixel below which a tile is sampled in no more than the least share.
    noise: f32,
    ssim_weight: f32,
    depth_weight: f32,
    // Of the draws.
    seed: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> setup: TileSamplingSetup;
// [tiles] see `loss_forward`; |colour error| is negative before the first step.
@group(0) @binding(2) var<storage, read> tile_losses: array<vec4<f32>>;
// [tiles / 32] one bit a tile, set if it is not sampled.
@group(0) @binding(3) var<storage, read_write> unsampled: array<u32>;

var<workgroup> sums: array<vec2<f32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    let tiles = view.tiles_x * view.tiles_y;
    var sum = vec2(0.0);
    for (var tile = local; tile < tiles; tile += 256u) {
        let loss = loss_of(tile);
        sum += select(vec2(0.0), vec2(loss, 1.0), loss >= 0.0);
    }
    sums[local] = sum;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half {
            sums[local] += sums[local + half];
        }
    }
    workgroupBarrier();
    let mean = sums[0].x / max(sums[0].y, 1.0);
    for (var word = local; word < min((tiles + 31u) / 32u, arrayLength(&unsampled)); word += 256u) {
        var bits = 0u;
        for (var bit = 0u; bit < min(32u, tiles - word * 32u); bit++) {
            bits |= select(0u, 1u << bit, is_unsampled(word * 32u + bit, mean));
        }
        unsampled[word] = bits;
    }
}

// Loss per pixel of a whole tile; negative if not known.
fn loss_of(tile: u32) -> f32 {
    let sums = tile_losses[tile] / f32(TILE_WIDTH * TILE_HEIGHT);
    let color = (1.0 - setup.ssim_weight) * sums.x / 3.0;
    let loss = color + setup.ssim_weight * (1.0 - sums.y / 3.0) + setup.depth_weight * sums.z;
    return select(loss, -1.0, sums.x < 0.0);
}

fn is_unsampled(tile: u32, mean: f32) -> bool {
    let loss = loss_of(tile);
    let wanted = select(setup.share * loss / max(mean, 1e-12), 0.0, loss < setup.noise);
    let known = loss >= 0.0;
    // Tiles one above the other share their draw: the loss works on pairs of them.
    let block = tile / (2u * view.tiles_x) * view.tiles_x + tile % view.tiles_x;
    return known && draw(block) >= max(wanted, setup.min_share);
}

// 0 to 1, by O'Neill's PCG hash.
fn draw(block: u32) -> f32 {
    return f32(pcg(pcg(block) + setup.seed) >> 8u) / 16777216.0;
}

fn pcg(value: u32) -> u32 {
    let state = value * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}
