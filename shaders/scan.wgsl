// Exclusive prefix sum of u32, reduce then scan (Merrill & Garland's two-level form): no forward-progress guarantee is needed.
// `reduce` sums blocks of SCAN_BLOCK elements, `sums` scans the block sums in one workgroup and publishes the total, `apply`
// scans within the blocks.

struct ScanSetup {
    // Elements to scan when `counter_in` is NONE, else the counter that says so.
    count: u32,
    counter_in: u32,
    // Counter that receives the total, and the room there is for that many elements.
    counter_out: u32,
    capacity: u32,
}

@group(0) @binding(0) var<uniform> setup: ScanSetup;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> prefix: array<u32>;
@group(0) @binding(4) var<storage, read_write> counters: array<Counter>;

const NONE: u32 = 0xffffffffu;
const PER_THREAD: u32 = SCAN_BLOCK / 256u;

var<workgroup> partial: array<u32, 256>;

fn element_count() -> u32 {
    if setup.counter_in == NONE {
        return setup.count;
    }
    return counters[setup.counter_in].count;
}

// Inclusive scan of `partial` over the workgroup.
fn scan_partial(local: u32) {
    for (var stride = 1u; stride < 256u; stride *= 2u) {
        workgroupBarrier();
        var addend = 0u;
        if local >= stride {
            addend = partial[local - stride];
        }
        workgroupBarrier();
        partial[local] += addend;
    }
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn reduce(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = linear_workgroup(workgroup, workgroups);
    let count = element_count();
    let first = block * SCAN_BLOCK + local * PER_THREAD;
    var sum = 0u;
    for (var k = first; k < min(first + PER_THREAD, count); k++) {
        sum += values[k];
    }
    partial[local] = sum;
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            partial[local] += partial[local + stride];
        }
    }
    if local == 0u {
        block_sums[block] = partial[0];
    }
}

@compute @workgroup_size(256)
fn sums(@builtin(local_invocation_index) local: u32) {
    let blocks = (element_count() + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    let share = (blocks + 255u) / 256u;
    let first = local * share;
    let end = min(first + share, blocks);
    var sum = 0u;
    for (var k = first; k < end; k++) {
        sum += block_sums[k];
    }
    partial[local] = sum;
    scan_partial(local);
    var running = partial[local] - sum;
    for (var k = first; k < end; k++) {
        let value = block_sums[k];
        block_sums[k] = running;
        running += value;
    }
    if local == 255u {
        let total = partial[255];
        let count = select(total, 0u, total > setup.capacity);
        counters[setup.counter_out].count = count;
        counters[setup.counter_out].needed = total;
        counters[setup.counter_out].per_element = dispatch_of((count + 255u) / 256u);
        counters[setup.counter_out].per_block = dispatch_of((count + SORT_BLOCK - 1u) / SORT_BLOCK);
    }
}

@compute @workgroup_size(256)
fn apply(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = linear_workgroup(workgroup, workgroups);
    let count = element_count();
    let first = block * SCAN_BLOCK + local * PER_THREAD;
    let end = min(first + PER_THREAD, count);
    var sum = 0u;
    for (var k = first; k < end; k++) {
        sum += values[k];
    }
    partial[local] = sum;
    scan_partial(local);
    var running = partial[local] - sum;
    if first < count {
        running += block_sums[block];
    }
    for (var k = first; k < end; k++) {
        let value = values[k];
        prefix[k] = running;
        running += value;
    }
}
