// Projects every Gaussian of the map into a view: image mean, conic_factor, opacity, colour, depth; and says which can be seen at all.
// One invocation a Gaussian. A culled one costs its tests only. Guards are written so that NaN fails them.

@group(0) @binding(0) var<uniform> view: View;
// [planes, capacity], see `render::GpuCloud`.
@group(0) @binding(1) var<storage, read> parameters: array<vec4<f32>>;
// [N, PROJECTED]: (mean x, mean y, depth, cut), (conic_factor xx, xy, yy, opacity),
// (r, g, b, half extents of the ellipse in pixels as two f16); of a planar surface also (depth's slope, metres a pixel along x and y, -, -).
@group(0) @binding(2) var<storage, read_write> projected: array<vec4<f32>>;
// [N] 1 where the Gaussian may touch the image.
@group(0) @binding(3) var<storage, read_write> visible: array<u32>;
// [N / 256] visible Gaussians of each workgroup.
@group(0) @binding(4) var<storage, read_write> block_sums: array<u32>;

var<workgroup> visible_here: atomic<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let block = linear_workgroup(workgroup);
    let i = block * 256u + local;
    if local == 0u {
        atomicStore(&visible_here, 0u);
    }
    workgroupBarrier();
    if i < view.gaussian_count {
        let is_visible = project(i);
        visible[i] = select(0u, 1u, is_visible);
        if is_visible {
            atomicAdd(&visible_here, 1u);
        }
    }
    workgroupBarrier();
    if local == 0u && i < view.gaussian_count {
        block_sums[block] = atomicLoad(&visible_here);
    }
}

// Half extents travel as f16: rounded up by more than its precision, and capped beyond any image.
const EXTENT_SLACK: f32 = 1.002;
const MAX_EXTENT: f32 = 60000.0;
const MAX_DETERMINANT: f32 = 1e30;
// Far beyond any picture; a NaN fails the comparison.
const MAX_COLOR: f32 = 1e6;

// A permutation of 32 bits in which nothing of the order is left (PCG; Jarzynski & Olano 2020).
fn hash(i: u32) -> u32 {
    let state = i * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}

fn project(i: u32) -> bool {
    let mean_opacity = parameters[i];
    let depth = dot(view.camera_row_2.xyz, mean_opacity.xyz) + view.camera_row_2.w;
    let opacity = sigmoid(mean_opacity.w) * view.opacity_gain;
    let is_dropped = hash(i + view.dropout_seed) < view.dropped_below;
    if !(depth > NEAR_METRES && depth < FAR_METRES && opacity >= ALPHA_MIN && !is_dropped) {
        return false;
    }
    let rotation = parameters[2u * view.capacity + i];
    let norm_squared = dot(rotation, rotation);
    if !(norm_squared >= MIN_QUATERNION_NORM_SQUARED) {
        return false;
    }
    let log_scale = parameters[view.capacity + i];
    let projection = project_gaussian(view, mean_opacity.xyz, log_scale, rotation * inverseSqrt(norm_squared));
    let c = projection.covariance;
    if !(projection.determinant >= MIN_DETERMINANT && projection.determinant < MAX_DETERMINANT) {
        return false;
    }
    let seen_opacity = opacity * projection.compensation;
    if !(seen_opacity >= ALPHA_MIN) {
        return false;
    }
    let p = projection.p_in_camera;
    let mean = view.intrinsics.xy * p.xy / p.z + view.intrinsics.zw;
    // -log(alpha) grows by ½dᵀΣ⁻¹d; alpha reaches ALPHA_MIN where that equals the cut.
    let cut = log(seen_opacity / ALPHA_MIN);
    let half_extent = sqrt(2.0 * cut * c.xz);
    let inside = (mean + half_extent >= vec2(-0.5)) & (mean - half_extent <= vec2(f32(view.width), f32(view.height)) - 0.5);
    if !all(inside) {
        return false;
    }
    let seen = color(i, mean_opacity.xyz);
    if !all(seen < vec3(MAX_COLOR)) {
        return false;
    }
    projected[PROJECTED * i] = vec4(mean, depth, cut);
    projected[PROJECTED * i + 1u] = vec4(conic_factor(projection), seen_opacity);
    projected[PROJECTED * i + 2u] = vec4(seen, bitcast<f32>(pack2x16float(min(half_extent * EXTENT_SLACK, vec2(MAX_EXTENT)))));
    //# planar
    let plane = plane_of(projection, log_scale.xyz, unit_axes(view, rotation * inverseSqrt(norm_squared)));
    projected[PROJECTED * i + 3u] = vec4(plane.slant * p.z / view.intrinsics.xy, 0.0, 0.0);
    //# end
    return true;
}

fn color(i: u32, mean: vec3<f32>) -> vec3<f32> {
    var sum = vec3(0.5) + 0.28209479 * parameters[3u * view.capacity + i].xyz;
    let coefficients = coefficient_count(view, arrayLength(&parameters));
    if coefficients > 1u {
        let direction = normalize(mean - view.center_in_world.xyz);
        for (var k = 1u; k < coefficients; k++) {
            sum += sh_basis(k, direction) * parameters[(3u + k) * view.capacity + i].xyz;
        }
    }
    // Not max(), which may turn a NaN into 0.
    return select(sum, vec3(0.0), sum < vec3(0.0));
}
