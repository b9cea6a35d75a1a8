// EWA projection of one Gaussian (Zwicker et al. 2001; Kerbl et al. 2023), shared by the forward and the backward pass.
//
// With N = R(q)·diag(s) the world covariance is N·Nᵀ. M = R_camera·N and T = J·M give the image covariance T·Tᵀ + dilation.
//
// An antialiased map has the two filters of Mip-Splatting (Yu et al. 2024). In space, s² grows by the square of SMOOTHING sampling intervals. In the image, the
// opacity shrinks as the dilation spreads the Gaussian. Without them the factors are 1, to the bit.

struct Projection {
    p_in_camera: vec3<f32>,
    // Columns are the Gaussian's axes scaled by their standard deviations, in the camera frame, metres.
    axes_in_camera: mat3x3<f32>,
    // Rows of the Jacobian of the pinhole projection at the (clamped) mean, pixels per metre.
    jacobian_x: vec3<f32>,
    jacobian_y: vec3<f32>,
    // Image covariance xx, xy, yy in pixels², dilated; and by how much.
    covariance: vec3<f32>,
    dilation: f32,
    determinant: f32,
    // The scaled axes in the image: columns of T, pixels.
    image_axis_0: vec2<f32>,
    image_axis_1: vec2<f32>,
    image_axis_2: vec2<f32>,
    // 1 where x/z (y/z) was inside its bounds, 0 where clamped.
    inside: vec2<f32>,
    // Standard deviations after the smoothing, metres, and the share of their squares that they had before it.
    scale: vec3<f32>,
    kept: vec3<f32>,
    // Determinant without the dilation.
    sharp_determinant: f32,
    // Factor of the opacity.
    compensation: f32,
}

// Logarithm of the smallest scale whose smoothing is told from that of a point.
const LEAST_LOG_SCALE: f32 = -30.0;

fn rotation_matrix(q: vec4<f32>) -> mat3x3<f32> {
    // q = (w, x, y, z) of unit length.
    let w = q.x;
    let v = q.yzw;
    return mat3x3(
        vec3(1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + w * v.z), 2.0 * (v.x * v.z - w * v.y)),
        vec3(2.0 * (v.x * v.y - w * v.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + w * v.x)),
        vec3(2.0 * (v.x * v.z + w * v.y), 2.0 * (v.y * v.z - w * v.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y)),
    );
}

// Lane w of the log scale is the sampling interval, metres; 0 smooths nothing.
fn project_gaussian(view_: View, mean: vec3<f32>, log_scale: vec4<f32>, unit_rotation: vec4<f32>) -> Projection {
    var out: Projection;
    let p = rotate_to_camera(view_, mean) + translation(view_);
    let smoothing = SMOOTHING * log_scale.w * exp(-max(log_scale.xyz, vec3(LEAST_LOG_SCALE)));
    let growth = 1.0 + smoothing * smoothing;
    let scale = exp(log_scale.xyz) * sqrt(growth);
    out.scale = scale;
    out.kept = 1.0 / growth;
    let axes = rotation_matrix(unit_rotation);
    out.p_in_camera = p;
    out.axes_in_camera = mat3x3(
        rotate_to_camera(view_, axes[0] * scale.x),
        rotate_to_camera(view_, axes[1] * scale.y),
        rotate_to_camera(view_, axes[2] * scale.z),
    );
    let inverse_z = 1.0 / p.z;
    let tangent = p.xy * inverse_z;
    let clamped = clamp(tangent, view_.tangent_bounds.xz, view_.tangent_bounds.yw);
    out.inside = select(vec2(0.0), vec2(1.0), tangent == clamped);
    out.jacobian_x = vec3(view_.intrinsics.x * inverse_z, 0.0, -view_.intrinsics.x * clamped.x * inverse_z);
    out.jacobian_y = vec3(0.0, view_.intrinsics.y * inverse_z, -view_.intrinsics.y * clamped.y * inverse_z);
    let row_x = out.jacobian_x * out.axes_in_camera;
    let row_y = out.jacobian_y * out.axes_in_camera;
    out.dilation = mix(DILATION, ANTIALIASED_DILATION, view_.antialiased);
    out.covariance = vec3(dot(row_x, row_x) + out.dilation, dot(row_x, row_y), dot(row_y, row_y) + out.dilation);
    // |x|²|y|² - (x·y)² = |x×y|²: without this a needle's determinant drowns in rounding.
    let area = cross(row_x, row_y);
    out.sharp_determinant = dot(area, area);
    out.determinant = out.sharp_determinant + out.dilation * (out.covariance.x + out.covariance.z - out.dilation);
    let undiluted = sqrt(max(out.sharp_determinant / out.determinant, LEAST_UNDILUTED));
    out.compensation = sqrt(out.kept.x * out.kept.y * out.kept.z) * mix(1.0, undiluted, view_.antialiased);
    out.image_axis_0 = vec2(row_x.x, row_y.x);
    out.image_axis_1 = vec2(row_x.y, row_y.y);
    out.image_axis_2 = vec2(row_x.z, row_y.z);
    return out;
}

// (l_xx, l_xy, l_yy) of d ↦ (l_xx dx + l_xy dy, l_yy dy), whose squared length is ½dᵀΣ⁻¹d: a sum of squares, which cannot turn negative
// and loses nothing to cancellation where a needle's conic would.
fn conic_factor(p: Projection) -> vec3<f32> {
    let c = p.covariance;
    let inverse = inverseSqrt(2.0 * c.z);
    return vec3(c.z * inverseSqrt(p.determinant), -c.y * inverseSqrt(p.determinant), 1.0) * inverse;
}

// Σ⁻¹v of the image covariance: the adjugate of a sum of outer products t·tᵀ is the sum of those of the perpendiculars.
fn inverse_covariance(p: Projection, v: vec2<f32>) -> vec2<f32> {
    let sum = across(p.image_axis_0, v) + across(p.image_axis_1, v) + across(p.image_axis_2, v);
    return (p.dilation * v + sum) / p.determinant;
}

// The part of v across the axis t, times |t|².
fn across(t: vec2<f32>, v: vec2<f32>) -> vec2<f32> {
    let perpendicular = vec2(t.y, -t.x);
    return perpendicular * dot(perpendicular, v);
}

//# planar
// The plane that stands for a Gaussian where rays are dense in it (RaDe-GS, Zhang et al. 2024): along the ray r of each pixel its density is largest at
// z(r) = (rᵀΛp)/(rᵀΛr), Λ the inverse of its covariance, p its mean. That is linear about the mean: dz = z·slant·dr, slant = -n_xy/(n·r), n = Λp. Of a flat
// Gaussian, n is the normal and this its plane; of a round one, the plane across the ray.
struct Plane {
    slant: vec2<f32>,
    // 1 where the slant is within its bounds, 0 where clamped.
    inside: vec2<f32>,
    // n, times the square of the thinnest axis; and its share of each axis: Λ's own value there, times the same.
    normal: vec3<f32>,
    shares: vec3<f32>,
    // The mean along each axis, metres.
    along: vec3<f32>,
}

// Axes of a Gaussian in the camera frame, of length one.
fn unit_axes(view_: View, unit_rotation: vec4<f32>) -> mat3x3<f32> {
    let axes = rotation_matrix(unit_rotation);
    return mat3x3(rotate_to_camera(view_, axes[0]), rotate_to_camera(view_, axes[1]), rotate_to_camera(view_, axes[2]));
}

fn plane_of(projection: Projection, log_scale: vec3<f32>, axes: mat3x3<f32>) -> Plane {
    var out: Plane;
    // Of the squared scales after the smoothing; these may be too small for f32.
    let log_squares = 2.0 * log_scale - log(projection.kept);
    out.shares = exp(min(min(log_squares.x, log_squares.y), log_squares.z) - log_squares);
    out.along = projection.p_in_camera * axes;
    out.normal = axes * (out.shares * out.along);
    let p = projection.p_in_camera;
    let slant = -out.normal.xy * p.z / dot(out.normal, p);
    out.slant = clamp(slant, vec2(-MOST_SLANT), vec2(MOST_SLANT));
    out.inside = select(vec2(0.0), vec2(1.0), slant == out.slant);
    return out;
}
//# end

fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-x));
}
