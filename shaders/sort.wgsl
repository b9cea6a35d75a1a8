// One pass of a stable least-significant-digit radix sort with 8-bit digits, reduce then scan.
//
// A block of SORT_BLOCK keys is ranked in rounds of 256: each invocation sets its bit in the mask of its digit (an OR commutes, so
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
// [blocks, 256] digit counts, then the first output position of each digit of each block.
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

var<workgroup> digit_counts: array<atomic<u32>, 256>;
// [256 digits, 8 words]: who of the 256 invocations holds which digit.
var<workgroup> masks: array<atomic<u32>, 2048>;
var<workgroup> bases: array<u32, 256>;

fn digit_of(key: u32) -> u32 {
    return (key >> setup.shift) & 255u;
}

@compute @workgroup_size(256)
fn count_digits(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = linear_workgroup(workgroup, workgroups);
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

// One workgroup: invocation d turns the counts of digit d into output positions.
@compute @workgroup_size(256)
fn scan_digits(@builtin(local_invocation_index) local: u32) {
    let count = counters[setup.counter].count;
    let blocks = (count + SORT_BLOCK - 1u) / SORT_BLOCK;
    var total = 0u;
    for (var block = 0u; block < blocks; block++) {
        total += histogram[block * 256u + local];
    }
    bases[local] = total;
    for (var stride = 1u; stride < 256u; stride *= 2u) {
        workgroupBarrier();
        var addend = 0u;
        if local >= stride {
            addend = bases[local - stride];
        }
        workgroupBarrier();
        bases[local] += addend;
    }
    workgroupBarrier();
    var running = bases[local] - total;
    for (var block = 0u; block < blocks; block++) {
        let digits = histogram[block * 256u + local];
        histogram[block * 256u + local] = running;
        running += digits;
    }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = linear_workgroup(workgroup, workgroups);
    let count = counters[setup.counter].count;
    if block * SORT_BLOCK < count {
        bases[local] = histogram[block * 256u + local];
    }
    let word = local / 32u;
    let bit = local % 32u;
    for (var round = 0u; round < SORT_BLOCK / 256u; round++) {
        for (var w = 0u; w < 8u; w++) {
            atomicStore(&masks[local * 8u + w], 0u);
        }
        workgroupBarrier();
        let i = block * SORT_BLOCK + round * 256u + local;
        var key = 0u;
        if i < count {
            key = keys_in[i];
            atomicOr(&masks[digit_of(key) * 8u + word], 1u << bit);
        }
        workgroupBarrier();
        if i < count {
            let digit = digit_of(key);
            var rank = countOneBits(atomicLoad(&masks[digit * 8u + word]) & ((1u << bit) - 1u));
            for (var w = 0u; w < word; w++) {
                rank += countOneBits(atomicLoad(&masks[digit * 8u + w]));
            }
            let position = bases[digit] + rank;
            keys_out[position] = key;
            values_out[position] = values_in[i];
        }
        workgroupBarrier();
        var held = 0u;
        for (var w = 0u; w < 8u; w++) {
            held += countOneBits(atomicLoad(&masks[local * 8u + w]));
        }
        bases[local] += held;
        // The next round clears only this invocation's own masks, but others read `bases`.
        workgroupBarrier();
    }
}
