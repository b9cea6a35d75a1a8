// Sink of `project_backward` that writes the gradient down, for tests and for whoever steps elsewhere. Cleared beforehand.
@group(0) @binding(4) var<storage, read> parameters: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> gradients: array<vec4<f32>>;

fn is_wanted(i: u32) -> bool {
    return true;
}

fn begin_gradient(i: u32, interval: f32) {}

fn wants_harmonics() -> bool {
    return true;
}

fn store_gradient(plane: u32, i: u32, gradient: vec4<f32>) {
    gradients[plane * view.capacity + i] = gradient;
}
