// Sink of `project_backward` that steps Adam (Kingma & Ba 2015) at once: the gradient never leaves the registers. Only Gaussians that
// were blended in this view get here; each counts its own steps, so that the bias correction is right for those often skipped.

struct AdamSetup {
    // Step sizes by lane: plane 0 (position ×3, in units of the Gaussian's own size; opacity), log scale, rotation, constant colour, other
    // harmonics.
    rates: array<vec4<f32>, 5>,
    beta_1: f32,
    beta_2: f32,
    epsilon: f32,
    // log β, for the bias corrections.
    log_beta_1: f32,
    log_beta_2: f32,
    // 1 on the steps that move the higher harmonics, else 0.
    step_harmonics: u32,
    // Logarithm of how many times longer than its second axis a Gaussian's longest may become.
    log_elongation: f32,
    // Logarithm of the share of its second axis to which its shortest shrinks; beyond all logarithms where there is none.
    log_thickness: f32,
    // Inverse of the number of steps with whose root the steps of colours shrink; 0: they don't.
    color_settling: f32,
    // The same of all other parameters.
    geometry_settling: f32,
    // Least share that the present parameters have in their averages.
    least_share: f32,
    // Gaussians before this place never move.
    frozen: u32,
    // Weight of the squares of the higher harmonics in the loss summed over the pixels, halved.
    harmonics_prior: f32,
}

// The share after n steps is 1/(1 + n/this), but the least at least.
const AVERAGED_PART: f32 = 4.0;

@group(0) @binding(4) var<storage, read_write> parameters: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> moments_1: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> moments_2: array<vec4<f32>>;
@group(0) @binding(7) var<uniform> adam: AdamSetup;
// The parameters over each Gaussian's last steps, on average: where successive views pull to and fro, it stays in between. Lane w of plane
// 3 counts the steps. Lane w of plane 1 is the sampling interval in parameters and averages both, metres: the least of all views so far.
@group(0) @binding(8) var<storage, read_write> averages: array<vec4<f32>>;

// Bias corrections 1/(1 - βⁿ) of the first and the second moments after this step: of all planes, and of the higher harmonics.
var<private> corrections: vec2<f32>;
var<private> corrections_of_harmonics: vec2<f32>;
// Shares of their rates that the geometry and the colours still take.
var<private> paces: vec2<f32>;
// Share of the present parameters in their averages, 0 to 1.
var<private> share: f32;
// Geometric mean of the standard deviations, metres.
var<private> size: f32;

// This view's sampling interval at the Gaussian, metres; 0 where the map is not antialiased.
var<private> sampling_interval: f32;

fn is_wanted(i: u32) -> bool {
    return i >= adam.frozen && moments_2[view.capacity + i].w == 0.0;
}

// In the second moments, lane w of plane 1 marks a fixed Gaussian (`fix`).
// In the first moments, lane w of planes 1 and 3 counts the Gaussian's steps, of all and of its higher harmonics.
fn begin_gradient(i: u32, interval: f32) {
    sampling_interval = interval;
    let log_scale = parameters[view.capacity + i];
    size = min(exp((log_scale.x + log_scale.y + log_scale.z) / 3.0), 1e3);
    corrections = count_step(view.capacity + i);
    paces = inverseSqrt(1.0 + moments_1[view.capacity + i].w * vec2(adam.geometry_settling, adam.color_settling));
    share = max(1.0 / (1.0 + averages[3u * view.capacity + i].w / AVERAGED_PART), adam.least_share);
    if wants_harmonics() {
        corrections_of_harmonics = count_step(3u * view.capacity + i);
    }
}

fn count_step(at: u32) -> vec2<f32> {
    let steps = moments_1[at].w + 1.0;
    moments_1[at].w = steps;
    return 1.0 / (1.0 - exp(steps * vec2(adam.log_beta_1, adam.log_beta_2)));
}

fn least_interval(before: f32) -> f32 {
    return select(min(before, sampling_interval), sampling_interval, before == 0.0);
}

// The length never decides; see `coefficient_count`.
fn wants_harmonics() -> bool {
    return min(adam.step_harmonics, arrayLength(&parameters)) == 1u;
}

// Log scales without a needle's tip: needles fit one view's edge and stick out of all others.
fn blunt(log_scale: vec4<f32>) -> vec4<f32> {
    let longest = max(max(log_scale.x, log_scale.y), log_scale.z);
    let shortest = min(min(log_scale.x, log_scale.y), log_scale.z);
    let second = log_scale.x + log_scale.y + log_scale.z - longest - shortest;
    return vec4(min(log_scale.xyz, vec3(second + adam.log_elongation)), least_interval(log_scale.w));
}

// Log scales of which the shortest comes nearer to its share of the second, by one step of their rate at least.
fn flatten(before: vec4<f32>, log_scale: vec4<f32>) -> vec4<f32> {
    let longest = max(max(log_scale.x, log_scale.y), log_scale.z);
    let shortest = min(min(log_scale.x, log_scale.y), log_scale.z);
    let second = log_scale.x + log_scale.y + log_scale.z - longest - shortest;
    let flat = min(log_scale.xyz, max(vec3(second + adam.log_thickness), before.xyz - adam.rates[1].x));
    // Of equal axes the last is the shortest: insertion has the normal there.
    let is_shortest = log_scale.xyz == vec3(shortest);
    let is_last = vec3(is_shortest.x && !is_shortest.y && !is_shortest.z, is_shortest.y && !is_shortest.z, is_shortest.z);
    return vec4(select(log_scale.xyz, flat, is_last), log_scale.w);
}

fn store_gradient(plane: u32, i: u32, raw: vec4<f32>) {
    let at = plane * view.capacity + i;
    let correction = select(corrections, corrections_of_harmonics, plane > 3u);
    // A gradient that overflowed (or NaN) moves nothing.
    let finite = select(vec4(0.0), raw, abs(raw) < vec4(1e15));
    let prior = select(0.0, adam.harmonics_prior / f32(view.width * view.height), plane > 3u);
    let gradient = finite + prior * parameters[at];
    let before = moments_1[at];
    let m = mix(gradient, before, adam.beta_1);
    let v = mix(gradient * gradient, moments_2[at], adam.beta_2);
    let unit = select(vec4(1.0), vec4(size, size, size, 1.0), plane == 0u);
    let rate = adam.rates[min(plane, 4u)] * unit * correction.x * select(paces.y, paces.x, plane < 3u);
    let moved = parameters[at] - rate * m / (sqrt(v * correction.y) + adam.epsilon);
    let now = select(moved, flatten(parameters[at], blunt(moved)), plane == 1u);
    parameters[at] = now;
    let average = averages[at];
    let mean = mix(average, now, share);
    averages[at] = select(vec4(mean.xyz, select(mean.w, average.w + 1.0, plane == 3u)), vec4(blunt(mean).xyz, now.w), plane == 1u);
    moments_1[at] = select(m, vec4(m.xyz, before.w), plane == 1u || plane == 3u);
    moments_2[at] = v;
}
