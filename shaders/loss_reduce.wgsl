// Sums the loss terms of all tiles in a fixed order, and writes the log of the step; one workgroup.

// Host twin: `render::layout::StepLog`.
struct StepLog {
    // (Σ|colour error|, Σ SSIM, Σ|depth error|, Σ squared colour error).
    loss: vec4<f32>,
    counters: array<Counter, 2>,
}

// [workgroups], see `loss_forward`.
@group(0) @binding(0) var<storage, read> loss_sums: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> counters: array<Counter>;
@group(0) @binding(2) var<storage, read_write> log_: StepLog;

var<workgroup> sums: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    var sum = vec4(0.0);
    for (var i = local; i < arrayLength(&loss_sums); i += 256u) {
        sum += loss_sums[i];
    }
    sums[local] = sum;
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            sums[local] += sums[local + stride];
        }
    }
    if local == 0u {
        log_.loss = sums[0];
    }
    if local < 2u {
        log_.counters[local] = counters[local];
    }
}
