// Sorts each tile's list by depth, one workgroup a tile; intersections of equal depth keys keep the order of the map, which is that of their slots. So the result
// does not depend on the order in which they were listed.
//
// Batcher's bitonic sort (1968) with all comparisons in one direction, which any length suits: what lies beyond the list counts as behind all of it. Blocks of
// `size` become sorted: the second half of each is compared with the mirror image of its first, then halves with halves. Up to CHUNK intersections are sorted in
// workgroup memory; of longer lists, the comparisons that reach further are made where they lie.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2<u32>>;
// [intersections] Gaussian of each slot.
@group(0) @binding(2) var<storage, read> slot_gaussians: array<u32>;
// [N, PROJECTED], see `project_forward`.
@group(0) @binding(3) var<storage, read> projected: array<vec4<f32>>;
// [intersections] slots of the tiles' lists.
@group(0) @binding(4) var<storage, read_write> slots: array<u32>;
// [intersections] depth keys of long lists.
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;

// [intersections] Gaussian of each, in the order of the lists.
@group(0) @binding(6) var<storage, read_write> sorted_gaussians: array<u32>;

const THREADS: u32 = 64u;
const CHUNK: u32 = 512u;

// (depth key, slot)
var<workgroup> items: array<vec2<u32>, CHUNK>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let range = ranges[tile];
    let count = range.y - range.x;
    let is_long = count > CHUNK;
    for (var start = 0u; start < count; start += CHUNK) {
        let length = min(count - start, CHUNK);
        for (var k = local; k < length; k += THREADS) {
            let slot = slots[range.x + start + k];
            items[k] = vec2(depth_key(projected[PROJECTED * slot_gaussians[slot]].z), slot);
        }
        workgroupBarrier();
        for (var size = 2u; size < 2u * length; size *= 2u) {
            for (var pair = local; pair < pairs(length, size); pair += THREADS) {
                let within = pair & (size / 2u - 1u);
                let first = 2u * (pair - within);
                put_in_order(length, first + within, first + size - 1u - within);
            }
            workgroupBarrier();
            merge_halves(length, size / 4u, local);
        }
        store_chunk(range.x + start, length, is_long, local);
    }
    for (var size = 2u * CHUNK; size < 2u * count; size *= 2u) {
        for (var pair = local; pair < pairs(count, size); pair += THREADS) {
            let within = pair & (size / 2u - 1u);
            let first = 2u * (pair - within);
            put_far_in_order(range, first + within, first + size - 1u - within);
        }
        storageBarrier();
        for (var half = size / 4u; half >= CHUNK; half /= 2u) {
            for (var pair = local; pair < pairs(count, 2u * half); pair += THREADS) {
                let first = 2u * pair - (pair & (half - 1u));
                put_far_in_order(range, first, first + half);
            }
            storageBarrier();
        }
        for (var start = 0u; start < count; start += CHUNK) {
            let length = min(count - start, CHUNK);
            for (var k = local; k < length; k += THREADS) {
                items[k] = vec2(keys[range.x + start + k], slots[range.x + start + k]);
            }
            workgroupBarrier();
            merge_halves(length, CHUNK / 2u, local);
            store_chunk(range.x + start, length, true, local);
        }
    }
}

// Pairs to compare in blocks of `size`, the last of which may be incomplete.
fn pairs(count: u32, size: u32) -> u32 {
    return ((count + size - 1u) & ~(size - 1u)) / 2u;
}

// Compares halves of blocks in workgroup memory, the largest first.
fn merge_halves(length: u32, largest: u32, local: u32) {
    for (var half = largest; half > 0u; half /= 2u) {
        for (var pair = local; pair < pairs(length, 2u * half); pair += THREADS) {
            let first = 2u * pair - (pair & (half - 1u));
            put_in_order(length, first, first + half);
        }
        workgroupBarrier();
    }
}

fn store_chunk(to: u32, length: u32, is_long: bool, local: u32) {
    for (var k = local; k < length; k += THREADS) {
        slots[to + k] = items[k].y;
        sorted_gaussians[to + k] = slot_gaussians[items[k].y];
        if is_long {
            keys[to + k] = items[k].x;
        }
    }
    workgroupBarrier();
    storageBarrier();
}

fn put_in_order(length: u32, i: u32, j: u32) {
    if j >= length {
        return;
    }
    let first = items[i];
    let second = items[j];
    if is_behind(first, second) {
        items[i] = second;
        items[j] = first;
    }
}

fn put_far_in_order(range: vec2<u32>, i: u32, j: u32) {
    if range.x + j >= range.y {
        return;
    }
    let first = vec2(keys[range.x + i], slots[range.x + i]);
    let second = vec2(keys[range.x + j], slots[range.x + j]);
    if is_behind(first, second) {
        keys[range.x + i] = second.x;
        slots[range.x + i] = second.y;
        keys[range.x + j] = first.x;
        slots[range.x + j] = first.y;
    }
}

fn is_behind(first: vec2<u32>, second: vec2<u32>) -> bool {
    return first.x > second.x || (first.x == second.x && first.y > second.y);
}
