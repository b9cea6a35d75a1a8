// Sorts each tile's list by depth, one workgroup a tile; intersections of equal depth keys keep the order of the map, which is that of their slots. So the result
// does not depend on the order in which they were listed.
//
// Batcher's bitonic sort (1968) with all comparisons in one direction, which any length suits: what lies beyond the list counts as behind all of it. Short lists
// are sorted in workgroup memory, long ones where they lie.

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

const THREADS: u32 = 64u;
// Intersections that workgroup memory holds.
const SHORT: u32 = 1024u;

// (depth key, slot)
var<workgroup> items: array<vec2<u32>, SHORT>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let range = ranges[tile];
    let count = range.y - range.x;
    let is_short = count <= SHORT;
    for (var k = local; k < count; k += THREADS) {
        let slot = slots[range.x + k];
        let key = depth_key(projected[PROJECTED * slot_gaussians[slot]].z);
        if is_short {
            items[k] = vec2(key, slot);
        } else {
            keys[range.x + k] = key;
        }
    }
    wait(is_short);
    // Blocks of `size` become sorted: each one's second half is compared with the mirror image of its first, then halves with halves.
    for (var size = 2u; size < 2u * count; size *= 2u) {
        // The last block may be incomplete.
        let pairs = ((count + size - 1u) & ~(size - 1u)) / 2u;
        for (var pair = local; pair < pairs; pair += THREADS) {
            let within = pair & (size / 2u - 1u);
            let first = 2u * (pair - within);
            put_in_order(range.x, count, first + within, first + size - 1u - within, is_short);
        }
        wait(is_short);
        for (var half = size / 4u; half > 0u; half /= 2u) {
            for (var pair = local; pair < pairs; pair += THREADS) {
                let first = 2u * pair - (pair & (half - 1u));
                put_in_order(range.x, count, first, first + half, is_short);
            }
            wait(is_short);
        }
    }
    if is_short {
        for (var k = local; k < count; k += THREADS) {
            slots[range.x + k] = items[k].y;
        }
    }
}

fn wait(is_short: bool) {
    workgroupBarrier();
    if !is_short {
        storageBarrier();
    }
}

fn put_in_order(start: u32, count: u32, i: u32, j: u32, is_short: bool) {
    if j >= count {
        return;
    }
    if is_short {
        let first = items[i];
        let second = items[j];
        if is_behind(first, second) {
            items[i] = second;
            items[j] = first;
        }
        return;
    }
    let first = vec2(keys[start + i], slots[start + i]);
    let second = vec2(keys[start + j], slots[start + j]);
    if is_behind(first, second) {
        keys[start + i] = second.x;
        slots[start + i] = second.y;
        keys[start + j] = first.x;
        slots[start + j] = first.y;
    }
}

fn is_behind(first: vec2<u32>, second: vec2<u32>) -> bool {
    return first.x > second.x || (first.x == second.x && first.y > second.y);
}
