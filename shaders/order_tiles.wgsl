// Lists the tiles that have Gaussians, then those that have none: a workgroup of the blending passes takes several, and one with nothing
// to do would idle beside one that has. Neighbours stay together, for they share Gaussians. One workgroup.

@group(0) @binding(0) var<uniform> view: View;
// [tiles] ranges of intersections; behind them [tiles] (tile, 0).
@group(0) @binding(1) var<storage, read_write> ranges: array<vec2<u32>>;

// Filled tiles of each invocation's stretch, then those before it; last, all of them.
var<workgroup> filled_before: array<u32, 257>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    // The length never decides; see `coefficient_count`.
    let tiles = min(view.tiles_x * view.tiles_y, arrayLength(&ranges) / 2u);
    let stretch = (tiles + 255u) / 256u;
    let first = min(local * stretch, tiles);
    let end = min(first + stretch, tiles);
    var count = 0u;
    for (var tile = first; tile < end; tile++) {
        count += select(0u, 1u, is_filled(ranges[tile]));
    }
    filled_before[local] = count;
    workgroupBarrier();
    if local == 0u {
        var before = 0u;
        for (var i = 0u; i < 256u; i++) {
            let next = before + filled_before[i];
            filled_before[i] = before;
            before = next;
        }
        filled_before[256] = before;
    }
    workgroupBarrier();
    var filled = filled_before[local];
    var empty = filled_before[256] + first - filled;
    for (var tile = first; tile < end; tile++) {
        let goes_first = is_filled(ranges[tile]);
        ranges[tiles + select(empty, filled, goes_first)] = vec2(tile, 0u);
        filled += select(0u, 1u, goes_first);
        empty += select(1u, 0u, goes_first);
    }
}

fn is_filled(range: vec2<u32>) -> bool {
    return range.y > range.x;
}
