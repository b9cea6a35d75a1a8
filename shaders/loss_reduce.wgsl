// Sums the loss terms of all workgroups in a fixed order; one workgroup.
@group(0) @binding(0) var<storage, read> loss_sums: array<vec4<f32>>;
// (Σ|colour error|, Σ SSIM, Σ|depth error|, Σ squared colour error).
@group(0) @binding(1) var<storage, read_write> total: array<vec4<f32>>;

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
        total[0] = sums[0];
    }
}
