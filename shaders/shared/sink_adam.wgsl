// Sink of `project_backward` that steps Adam (Kingma & Ba 2015) at once: the gradient never leaves the registers. Only Gaussians that
// were blended in this view get here; each counts its own steps, so that the bias correction is right for those often skipped.

struct AdamSetup {
    // Step sizes by lane: plane 0 (position ×3, opacity), log scale, rotation, constant colour, other harmonics.
    rates: array<vec4<f32>, 5>,
    beta_1: f32,
    beta_2: f32,
    epsilon: f32,
    // log β, for the bias corrections.
    log_beta_1: f32,
    log_beta_2: f32,
    // 1 on the steps that move the higher harmonics, else 0.
    step_harmonics: u32,
}

@group(0) @binding(6) var<storage, read_write> parameters: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> moments_1: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> moments_2: array<vec4<f32>>;
@group(0) @binding(9) var<uniform> adam: AdamSetup;

// Lane w of planes 1 and 3 is free; in the first moments these count the Gaussian's steps, of all and of its higher harmonics.
fn begin_gradient(i: u32) {
    moments_1[view.capacity + i].w += 1.0;
    if adam.step_harmonics == 1u {
        moments_1[3u * view.capacity + i].w += 1.0;
    }
}

fn wants_harmonics() -> bool {
    return adam.step_harmonics == 1u;
}

fn store_gradient(plane: u32, i: u32, raw: vec4<f32>) {
    let at = plane * view.capacity + i;
    let steps = moments_1[select(1u, 3u, plane > 3u) * view.capacity + i].w;
    // A gradient that overflowed (or NaN) moves nothing.
    let gradient = select(vec4(0.0), raw, abs(raw) < vec4(1e15));
    let m = mix(gradient, moments_1[at], adam.beta_1);
    let v = mix(gradient * gradient, moments_2[at], adam.beta_2);
    let unbiased_m = m / (1.0 - exp(steps * adam.log_beta_1));
    let unbiased_v = v / (1.0 - exp(steps * adam.log_beta_2));
    let rate = adam.rates[min(plane, 4u)];
    parameters[at] -= rate * unbiased_m / (sqrt(unbiased_v) + adam.epsilon);
    moments_1[at] = select(m, vec4(m.xyz, moments_1[at].w), plane == 1u || plane == 3u);
    moments_2[at] = v;
}
