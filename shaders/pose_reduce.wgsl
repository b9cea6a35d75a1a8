// Sums the pose gradient over the workgroups of `project_backward`, in a fixed order; one workgroup.
@group(0) @binding(0) var<storage, read> counters: array<Counter>;
@group(0) @binding(1) var<storage, read> pose_sums: array<vec4<f32>>;
// (∂L/∂ρ, 0), (∂L/∂θ, 0).
@group(0) @binding(2) var<storage, read_write> pose_gradient: array<vec4<f32>>;

var<workgroup> rho_sums: array<vec4<f32>, 256>;
var<workgroup> theta_sums: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    let blocks = (counters[VISIBLE_COUNTER].count + 255u) / 256u;
    var rho = vec4(0.0);
    var theta = vec4(0.0);
    for (var i = local; i < blocks; i += 256u) {
        rho += pose_sums[i * 2u];
        theta += pose_sums[i * 2u + 1u];
    }
    rho_sums[local] = rho;
    theta_sums[local] = theta;
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            rho_sums[local] += rho_sums[local + stride];
            theta_sums[local] += theta_sums[local + stride];
        }
    }
    if local == 0u {
        pose_gradient[0] = rho_sums[0];
        pose_gradient[1] = theta_sums[0];
    }
}
