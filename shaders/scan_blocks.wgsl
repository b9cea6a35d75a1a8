// Exclusive prefix sum of the intersections that the workgroups of `tile_lists_*` leave behind, in one workgroup; publishes the total. The workgroups of the next
// pass scan within themselves: reduce then scan (Merrill & Garland's two-level form), without any guarantee of forward progress. In the wide form, a second workgroup
// turns the lengths of the tiles' lists into their places.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: array<Counter>;
// [tiles / 2] of two tiles: first place of the list, and its length, which becomes the first place as well: `tile_lists_wide` counts from there.
@group(0) @binding(3) var<storage, read_write> ranges: array<vec4<u32>>;

// Stands for any total that 32 bits may not hold.
const MOST: u32 = 0xffffffffu;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    if workgroup.x == 0u {
        scan_blocks(local);
    } else {
        scan_tiles(local);
    }
}

fn scan_blocks(local: u32) {
    // The length never decides; see `coefficient_count`.
    let blocks = min((counters[VISIBLE_COUNTER].count + 255u) / 256u, arrayLength(&block_sums));
    let share = (blocks + 255u) / 256u;
    let first = min(local * share, blocks);
    let end = min(first + share, blocks);
    var sum = 0u;
    for (var k = first; k < end; k++) {
        let value = block_sums[k];
        sum = select(sum + value, MOST, sum > MOST - value);
    }
    // The total in units of 256, lest it wrap.
    let coarse = exclusive_sum(local, sum / 256u) + sum / 256u;
    var running = exclusive_sum(local, sum);
    for (var k = first; k < end; k++) {
        let value = block_sums[k];
        block_sums[k] = running;
        running += value;
    }
    if local == 255u {
        let needed = select(running, MOST, coarse >= MOST / 256u - 256u);
        let count = select(needed, 0u, needed > view.intersection_capacity);
        counters[INTERSECTION_COUNTER] = counter_of(count, needed, view.tiles_x * view.tiles_y);
    }
}

fn scan_tiles(local: u32) {
    let pairs = min((view.tiles_x * view.tiles_y + 1u) / 2u, arrayLength(&ranges));
    let share = (pairs + 255u) / 256u;
    let first = min(local * share, pairs);
    let end = min(first + share, pairs);
    var sum = 0u;
    for (var k = first; k < end; k++) {
        let lists = ranges[k];
        sum += lists.y + lists.w;
    }
    var running = exclusive_sum(local, sum);
    for (var k = first; k < end; k++) {
        let lists = ranges[k];
        let second = running + lists.y;
        ranges[k] = vec4(running, running, second, second);
        running = second + lists.w;
    }
}
