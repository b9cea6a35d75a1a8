// Lists the tiles by the lengths of their lists, longest first: tiles of about the same length share a workgroup of the blending passes, and
// tiles without any Gaussians share theirs. One workgroup.

@group(0) @binding(0) var<uniform> view: View;
// [tiles] ranges of pairs; behind them [tiles] (tile, 0).
@group(0) @binding(1) var<storage, read_write> ranges: array<vec2<u32>>;

// Tiles of each length, then where the next of them goes. Which of two comes first decides nothing that is computed.
var<workgroup> next: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    // The length never decides; see `coefficient_count`.
    let tiles = min(view.tiles_x * view.tiles_y, arrayLength(&ranges) / 2u);
    for (var tile = local; tile < tiles; tile += 256u) {
        atomicAdd(&next[bucket_of(ranges[tile])], 1u);
    }
    workgroupBarrier();
    if local == 0u {
        var before = 0u;
        for (var bucket = 0u; bucket < 256u; bucket++) {
            let count = atomicLoad(&next[bucket]);
            atomicStore(&next[bucket], before);
            before += count;
        }
    }
    workgroupBarrier();
    for (var tile = local; tile < tiles; tile += 256u) {
        ranges[tiles + atomicAdd(&next[bucket_of(ranges[tile])], 1u)] = vec2(tile, 0u);
    }
}

// Eight to an octave of lengths; the longest have the lowest number.
fn bucket_of(range: vec2<u32>) -> u32 {
    let length = range.y - range.x;
    let eighths = (bitcast<u32>(f32(length)) >> 20u) - (127u << 3u);
    return 255u - select(min(eighths + 1u, 255u), 0u, length == 0u);
}
