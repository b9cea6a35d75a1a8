// Carries the intersections' gradients through the projection to each visible Gaussian's parameters.
//
// One invocation a visible Gaussian, in map order: neighbours' parameters lie side by side. A Gaussian's intersections do as well, and are summed
// in order. `is_wanted`, `begin_gradient` and `store_gradient` are the sink: it steps Adam at once (`shared/sink_adam.wgsl`) or writes the
// gradient down (`shared/sink_gradient.wgsl`).

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<Counter>;
// See `tile_lists`.
@group(0) @binding(2) var<storage, read> intersection_counts: array<u32>;
@group(0) @binding(3) var<storage, read> intersection_gradients: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let item = linear_workgroup(workgroup) * 256u + local;
    // Without room for all intersections nothing was rendered: the step will be repeated.
    if item < counters[VISIBLE_COUNTER].count && counters[INTERSECTION_COUNTER].count > 0u {
        let i = intersection_counts[3u * view.capacity + item];
        if is_wanted(i) {
            backward(i);
        }
    }
}

fn backward(i: u32) {
    var color_depth = vec4(0.0);
    var first = vec4(0.0);
    var second = vec4(0.0);
    let end = intersection_counts[view.capacity + 2u * i + 1u];
    var slot = intersection_counts[view.capacity + 2u * i];
    while slot < end {
        color_depth += intersection_gradients[slot * 3u];
        first += intersection_gradients[slot * 3u + 1u];
        second += intersection_gradients[slot * 3u + 2u];
        // `sum_slots` has left the sum of a chunk in its first slot.
        let is_sum = slot % SLOT_CHUNK == 0u && slot + SLOT_CHUNK <= end;
        slot += select(1u, SLOT_CHUNK, is_sum);
    }
    let untouched = all(color_depth == vec4(0.0)) && all(first == vec4(0.0)) && all(second == vec4(0.0));
    // What reaches into hidden pixels is not seen whole: it would grow over them for the sake of the others.
    let is_hidden = abs(color_depth.w) > MOST_GRADIENT;
    if untouched || is_hidden {
        return;
    }
    let mean_opacity = parameters[i];
    let log_scale = parameters[view.capacity + i];
    let rotation = parameters[2u * view.capacity + i];
    let inverse_norm = inverseSqrt(dot(rotation, rotation));
    let unit_rotation = rotation * inverse_norm;
    let projection = project_gaussian(view, mean_opacity.xyz, log_scale, unit_rotation);

    var by_mean_2d = inverse_covariance(projection, first.yz);
    //# planar
    // A Gaussian's depth at a pixel is z + slope·d. With n = Σ_j share_j·a_j(a_j·p) over its axes, shares falling with the square of the scales:
    let axes = unit_axes(view, unit_rotation);
    let plane = plane_of(projection, log_scale.xyz, axes);
    let by_slope = vec2(first.w, second.w) / view.intrinsics.xy;
    let p_z = projection.p_in_camera.z;
    by_mean_2d -= plane.slant * p_z / view.intrinsics.xy * color_depth.w;
    let by_slant = by_slope * p_z * plane.inside;
    let ray = projection.p_in_camera / p_z;
    let across = 1.0 / dot(plane.normal, ray);
    let turned = dot(by_slant, plane.slant) * across;
    let by_normal = -vec3(by_slant * across, 0.0) - turned * ray;
    let by_ray = -turned * plane.normal;
    let normal_along = by_normal * axes;
    let by_log_scale = -2.0 * plane.shares * plane.along * normal_along;
    let by_axes = mat3x3(
        plane.shares.x * (by_normal * plane.along.x + projection.p_in_camera * normal_along.x),
        plane.shares.y * (by_normal * plane.along.y + projection.p_in_camera * normal_along.y),
        plane.shares.z * (by_normal * plane.along.z + projection.p_in_camera * normal_along.z),
    );
    let by_plane_point =
        axes * (plane.shares * normal_along) + vec3(by_ray.xy / p_z, dot(by_slope, plane.slant) - dot(by_ray.xy, ray.xy) / p_z);
    //# end
    // log α = -½dᵀPd + …, P = Σ⁻¹: its gradient G by P is -½Σ q d·dᵀ, and by Σ it is -P·G·P. With T the image axes, Σ = T·Tᵀ + …, so
    // that by column t it is -2P·(G·(P·t)), and by the logarithm of that axis' scale -2(P·t)·G·(P·t).
    let by_inverse = -0.5 * second.xyz;
    let p_0 = inverse_covariance(projection, projection.image_axis_0);
    let p_1 = inverse_covariance(projection, projection.image_axis_1);
    let p_2 = inverse_covariance(projection, projection.image_axis_2);
    let g_0 = symmetric(by_inverse, p_0);
    let g_1 = symmetric(by_inverse, p_1);
    let g_2 = symmetric(by_inverse, p_2);
    // The compensation's logarithm is that of the determinants without and with the dilation, halved. By t it is Σ₀⁻¹t - Σ⁻¹t: a part of p = Σ⁻¹t
    // less one of t itself.
    let is_compensated = projection.sharp_determinant > LEAST_UNDILUTED * projection.determinant;
    let by_compensation = select(0.0, view.antialiased * first.x / projection.sharp_determinant, is_compensated);
    let part = by_compensation * vec2(projection.determinant - projection.sharp_determinant, projection.dilation);
    var by_smoothed = vec3(
        dot(p_0, part.x * projection.image_axis_0 - 2.0 * g_0) - part.y * dot(projection.image_axis_0, projection.image_axis_0),
        dot(p_1, part.x * projection.image_axis_1 - 2.0 * g_1) - part.y * dot(projection.image_axis_1, projection.image_axis_1),
        dot(p_2, part.x * projection.image_axis_2 - 2.0 * g_2) - part.y * dot(projection.image_axis_2, projection.image_axis_2),
    );
    //# planar
    by_smoothed += by_log_scale;
    //# end
    let by_image_0 = inverse_covariance(projection, part.x * projection.image_axis_0 - 2.0 * g_0) - part.y * projection.image_axis_0;
    let by_image_1 = inverse_covariance(projection, part.x * projection.image_axis_1 - 2.0 * g_1) - part.y * projection.image_axis_1;
    let by_image_2 = inverse_covariance(projection, part.x * projection.image_axis_2 - 2.0 * g_2) - part.y * projection.image_axis_2;
    // The least distance between two samples of the surface, where the map is antialiased.
    begin_gradient(i, view.antialiased * projection.p_in_camera.z / max(view.intrinsics.x, view.intrinsics.y));
    store_gradient(1u, i, vec4(projection.kept * by_smoothed + (1.0 - projection.kept) * first.x, 0.0));

    // T = J·M: gradients by M's columns, and by J's rows.
    let scale = projection.scale;
    var by_rotation_matrix = mat3x3(
        rotate_to_world(view, projection.jacobian_x * by_image_0.x + projection.jacobian_y * by_image_0.y) * scale.x,
        rotate_to_world(view, projection.jacobian_x * by_image_1.x + projection.jacobian_y * by_image_1.y) * scale.y,
        rotate_to_world(view, projection.jacobian_x * by_image_2.x + projection.jacobian_y * by_image_2.y) * scale.z,
    );
    //# planar
    by_rotation_matrix[0] += rotate_to_world(view, by_axes[0]);
    by_rotation_matrix[1] += rotate_to_world(view, by_axes[1]);
    by_rotation_matrix[2] += rotate_to_world(view, by_axes[2]);
    //# end
    let by_unit = quaternion_gradient(unit_rotation, by_rotation_matrix);
    store_gradient(2u, i, (by_unit - unit_rotation * dot(unit_rotation, by_unit)) * inverse_norm);

    let by_jacobian_x = projection.axes_in_camera * vec3(by_image_0.x, by_image_1.x, by_image_2.x);
    let by_jacobian_y = projection.axes_in_camera * vec3(by_image_0.y, by_image_1.y, by_image_2.y);
    var by_point = point_gradient(projection, by_mean_2d, color_depth.w, by_jacobian_x, by_jacobian_y);
    //# planar
    by_point += by_plane_point;
    //# end
    let by_mean_of_color = color_gradient(i, mean_opacity.xyz, color_depth.xyz);
    let opacity = sigmoid(mean_opacity.w);
    let by_mean = rotate_to_world(view, by_point) + by_mean_of_color;
    store_gradient(0u, i, vec4(by_mean, (1.0 - opacity) * first.x));
}

// Product of a symmetric matrix held as (xx, xy, yy).
fn symmetric(m: vec3<f32>, v: vec2<f32>) -> vec2<f32> {
    return vec2(m.x * v.x + m.y * v.y, m.y * v.x + m.z * v.y);
}

// Gradient with respect to the mean in the camera frame: through the image mean, the depth, and the Jacobian's own dependence.
fn point_gradient(projection: Projection, by_mean_2d: vec2<f32>, by_depth: f32, by_jacobian_x: vec3<f32>, by_jacobian_y: vec3<f32>) -> vec3<f32> {
    let f = view.intrinsics.xy;
    let p = projection.p_in_camera;
    let iz = 1.0 / p.z;
    let scaled = f * by_mean_2d * iz;
    var by_point = vec3(scaled, by_depth - dot(scaled, p.xy) * iz);
    // J holds f/z and -f·t/z, t the tangent: x/z inside its bounds, a constant where clamped.
    let by_slope = vec2(by_jacobian_x.z, by_jacobian_y.z) * f * iz * iz;
    let by_focal = vec2(by_jacobian_x.x, by_jacobian_y.y) * f * iz * iz;
    let tangent = vec2(-projection.jacobian_x.z, -projection.jacobian_y.z) * p.z / f;
    by_point -= vec3(by_slope * projection.inside, 0.0);
    by_point.z += dot(by_slope * tangent, vec2(1.0) + projection.inside) - by_focal.x - by_focal.y;
    return by_point;
}

// Stores the coefficients' gradients; returns the mean's gradient through the view direction, world frame.
fn color_gradient(i: u32, mean: vec3<f32>, by_color: vec3<f32>) -> vec3<f32> {
    let coefficients = coefficient_count(view, arrayLength(&parameters));
    let offset = mean - view.center_in_world.xyz;
    let distance = length(offset);
    let direction = offset / distance;
    var by_direction = vec3(0.0);
    for (var k = 0u; k < coefficients; k++) {
        by_direction += sh_basis_gradient(k, direction) * dot(parameters[(3u + k) * view.capacity + i].xyz, by_color);
        if k == 0u || wants_harmonics() {
            store_gradient(3u + k, i, vec4(sh_basis(k, direction) * by_color, 0.0));
        }
    }
    return (by_direction - direction * dot(direction, by_direction)) / distance;
}

// Gradient with respect to the unit quaternion (w, x, y, z), from that of the rotation matrix (columns).
fn quaternion_gradient(q: vec4<f32>, g: mat3x3<f32>) -> vec4<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return 2.0 * vec4(
        x * (g[1].z - g[2].y) + y * (g[2].x - g[0].z) + z * (g[0].y - g[1].x),
        w * (g[1].z - g[2].y) + y * (g[1].x + g[0].y) + z * (g[2].x + g[0].z) - 2.0 * x * (g[1].y + g[2].z),
        w * (g[2].x - g[0].z) + x * (g[1].x + g[0].y) + z * (g[2].y + g[1].z) - 2.0 * y * (g[0].x + g[2].z),
        w * (g[0].y - g[1].x) + x * (g[2].x + g[0].z) + y * (g[2].y + g[1].z) - 2.0 * z * (g[0].x + g[1].y),
    );
}
