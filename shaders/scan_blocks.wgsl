// Exclusive prefix sum of the counts that the workgroups of 256 leave behind, in one workgroup; publishes the total. The workgroups of the next
// pass scan within themselves: reduce then scan (Merrill & Garland's two-level form), without any guarantee of forward progress.

struct ScanSetup {
    // Counter that receives the total.
    counter: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> setup: ScanSetup;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: array<Counter>;

// Stands for any total that 32 bits may not hold.
const MOST: u32 = 0xffffffffu;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    let is_visible = setup.counter == VISIBLE_COUNTER;
    let elements = select(counters[VISIBLE_COUNTER].count, view.gaussian_count, is_visible);
    let capacity = select(view.intersection_capacity, view.gaussian_count, is_visible);
    // The length never decides; see `coefficient_count`.
    let blocks = min((elements + 255u) / 256u, arrayLength(&block_sums));
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
        let count = select(needed, 0u, needed > capacity);
        counters[setup.counter].count = count;
        counters[setup.counter].needed = needed;
        counters[setup.counter].per_element = dispatch_of((count + 255u) / 256u);
        counters[setup.counter].per_block = dispatch_of((count + SORT_BLOCK - 1u) / SORT_BLOCK);
        counters[setup.counter].per_bucket = dispatch_of(view.tiles_x * view.tiles_y + count / BUCKET + 1u);
    }
}
