// One pass of a stable least-significant-digit radix sort with 8-bit digits, reduce then scan.
//
// A block of SORT_BLOCK keys is ranked in rounds of 64: each invocation sets its bit in the mask of its digit (an OR commutes, so
// the result does not depend on order), and its rank is the number of lower bits set. No subgroup operations are needed.

struct SortSetup {
    // Right shift that brings the digit to the low 8 bits.
    shift: u32,
    // Counter that holds the number of keys.
    counter: u32,
}

@group(0) @binding(0) var<uniform> setup: SortSetup;
@group(0) @binding(1) var<storage, read> counters: array<Counter>;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
// [blocks, 256 digits] counts, then positions among the chunk's keys of that digit; behind them [chunks, 256] keys of each digit.
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

var<workgroup> digit_counts: array<atomic<u32>, 256>;
// [256 digits, 2 words]: who of the 64 invocations holds which digit.
var<workgroup> masks: array<atomic<u32>, 512>;
// Next output position of each digit.
var<workgroup> bases: array<u32, 256>;
var<workgroup> partial: array<u32, 64>;

fn digit_of(key: u32) -> u32 {
    return (key >> setup.shift) & 255u;
}

fn block_count(count: u32) -> u32 {
    return (count + SORT_BLOCK - 1u) / SORT_BLOCK;
}

// Sum of `value` over the invocations before this one.
fn exclusive_sum(local: u32, value: u32) -> u32 {
    partial[local] = value;
    for (var stride = 1u; stride < 64u; stride *= 2u) {
        workgroupBarrier();
        var addend = 0u;
        if local >= stride {
            addend = partial[local - stride];
        }
        workgroupBarrier();
        partial[local] += addend;
    }
    return partial[local] - value;
}

@compute @workgroup_size(256)
fn count_digits(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let count = counters[setup.counter].count;
    atomicStore(&digit_counts[local], 0u);
    workgroupBarrier();
    for (var k = local; k < SORT_BLOCK; k += 256u) {
        let i = block * SORT_BLOCK + k;
        if i < count {
            atomicAdd(&digit_counts[digit_of(keys_in[i])], 1u);
        }
    }
    workgroupBarrier();
    if block * SORT_BLOCK < count {
        histogram[block * 256u + local] = atomicLoad(&digit_counts[local]);
    }
}

// A workgroup takes SORT_CHUNK blocks, and invocation d turns their counts of digit d into positions among the chunk's keys of that
// digit; what they come to goes behind all blocks.
@compute @workgroup_size(256)
fn scan_digits(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let chunk = linear_workgroup(workgroup);
    let blocks = block_count(counters[setup.counter].count);
    var running = 0u;
    for (var block = chunk * SORT_CHUNK; block < min((chunk + 1u) * SORT_CHUNK, blocks); block++) {
        let keys = histogram[block * 256u + local];
        histogram[block * 256u + local] = running;
        running += keys;
    }
    if chunk * SORT_CHUNK < blocks {
        histogram[(blocks + chunk) * 256u + local] = running;
    }
}

@compute @workgroup_size(64)
fn scatter(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let count = counters[setup.counter].count;
    if block * SORT_BLOCK >= count {
        return;
    }
    for (var k = local; k < 512u; k += 64u) {
        atomicStore(&masks[k], 0u);
    }
    find_bases(block, block_count(count), local);
    let word = local / 32u;
    let bit = local % 32u;
    let end = min(count - block * SORT_BLOCK, SORT_BLOCK);
    for (var round = 0u; round < end; round += 64u) {
        let i = block * SORT_BLOCK + round + local;
        let valid = round + local < end;
        var key = 0u;
        if valid {
            key = keys_in[i];
            atomicOr(&masks[digit_of(key) * 2u + word], 1u << bit);
        }
        workgroupBarrier();
        let digit = digit_of(key);
        let low = atomicLoad(&masks[digit * 2u]);
        let high = atomicLoad(&masks[digit * 2u + 1u]);
        let base = bases[digit];
        let below = countOneBits(select(low & ((1u << bit) - 1u), low, word == 1u));
        let rank = below + select(0u, countOneBits(high & ((1u << bit) - 1u)), word == 1u);
        let held = countOneBits(low) + countOneBits(high);
        if valid {
            keys_out[base + rank] = key;
            values_out[base + rank] = values_in[i];
        }
        workgroupBarrier();
        // The last key of each digit leaves its mask and base ready for the next round.
        if valid && rank + 1u == held {
            atomicStore(&masks[digit * 2u], 0u);
            atomicStore(&masks[digit * 2u + 1u], 0u);
            bases[digit] = base + held;
        }
        workgroupBarrier();
    }
}

// Output position of the block's first key of each digit: behind the keys of smaller digits, and those of the same digit in earlier
// chunks and blocks.
fn find_bases(block: u32, blocks: u32, local: u32) {
    let chunks = (blocks + SORT_CHUNK - 1u) / SORT_CHUNK;
    var totals = vec4(0u);
    var before = vec4(0u);
    for (var chunk = 0u; chunk < chunks; chunk++) {
        let at = (blocks + chunk) * 256u + local * 4u;
        let keys = vec4(histogram[at], histogram[at + 1u], histogram[at + 2u], histogram[at + 3u]);
        before += select(vec4(0u), keys, chunk < block / SORT_CHUNK);
        totals += keys;
    }
    let at = block * 256u + local * 4u;
    before += vec4(histogram[at], histogram[at + 1u], histogram[at + 2u], histogram[at + 3u]);
    let smaller = exclusive_sum(local, totals.x + totals.y + totals.z + totals.w);
    let first = smaller + vec4(0u, totals.x, totals.x + totals.y, totals.x + totals.y + totals.z) + before;
    bases[local * 4u] = first.x;
    bases[local * 4u + 1u] = first.y;
    bases[local * 4u + 2u] = first.z;
    bases[local * 4u + 3u] = first.w;
    workgroupBarrier();
}
