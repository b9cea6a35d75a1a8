var<workgroup> values: array<u32, 256>;
var<workgroup> sixteens: array<u32, 16>;

// Sum of `value` over the invocations of the workgroup before this one, of 256: within sixteen neighbours, then over the sixteens before.
// Barriers cost a software adapter more than loads.
fn exclusive_sum(local: u32, value: u32) -> u32 {
    let neighbour = local % 16u;
    let sixteen = local / 16u;
    values[local] = value;
    workgroupBarrier();
    var sum = 0u;
    for (var i = 0u; i < 15u; i++) {
        sum += select(0u, values[sixteen * 16u + i], i < neighbour);
    }
    if neighbour == 15u {
        sixteens[sixteen] = sum + value;
    }
    workgroupBarrier();
    for (var i = 0u; i < 15u; i++) {
        sum += select(0u, sixteens[i], i < sixteen);
    }
    return sum;
}
