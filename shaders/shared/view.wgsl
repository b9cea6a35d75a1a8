// One camera view of the map; the host twin is `render::layout::View`.
struct View {
    // Rows of camera_from_world: rotation in xyz, translation in w; metres.
    camera_row_0: vec4<f32>,
    camera_row_1: vec4<f32>,
    camera_row_2: vec4<f32>,
    // Camera centre in the world, metres; w unused.
    center_in_world: vec4<f32>,
    // fx, fy, cx, cy in pixels.
    intrinsics: vec4<f32>,
    // Bounds on x/z and y/z inside the Jacobian: min x, max x, min y, max y.
    tangent_bounds: vec4<f32>,
    // Colour behind the map, RGB; w unused.
    background: vec4<f32>,
    // Image and tile grid sizes.
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles_y: u32,
    // Gaussians in the map, and the stride between parameter planes.
    gaussian_count: u32,
    capacity: u32,
    sh_degree: u32,
    intersection_capacity: u32,
    // 1 where the map is antialiased: opacities are compensated for the dilation; else 0.
    antialiased: f32,
    // Dropout: Gaussians whose hash is below this are left out, the opacities of the others grow by the gain. 0 and 1 without it.
    dropped_below: u32,
    dropout_seed: u32,
    opacity_gain: f32,
}

// Workgroups beyond 65,535 are laid out in further rows of as many.
fn linear_workgroup(workgroup: vec3<u32>) -> u32 {
    return workgroup.y * 65535u + workgroup.x;
}

fn rotate_to_camera(view_: View, v: vec3<f32>) -> vec3<f32> {
    return vec3(dot(view_.camera_row_0.xyz, v), dot(view_.camera_row_1.xyz, v), dot(view_.camera_row_2.xyz, v));
}

fn rotate_to_world(view_: View, v: vec3<f32>) -> vec3<f32> {
    return v.x * view_.camera_row_0.xyz + v.y * view_.camera_row_1.xyz + v.z * view_.camera_row_2.xyz;
}

fn translation(view_: View) -> vec3<f32> {
    return vec3(view_.camera_row_0.w, view_.camera_row_1.w, view_.camera_row_2.w);
}

// Harmonics of a Gaussian whose parameters' planes hold so many vectors. The length never decides: it is there because Mesa's software
// adapter compiles a shader anew in each step whose loops end at a uniform's value, and that costs more than the step.
fn coefficient_count(view_: View, parameter_vectors: u32) -> u32 {
    return min((view_.sh_degree + 1u) * (view_.sh_degree + 1u), parameter_vectors / view_.capacity);
}
