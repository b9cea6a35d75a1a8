// The 11-tap Gaussian window (σ = 1.5 pixels) of SSIM (Wang et al. 2004), zero beyond the image, as both
// loss passes use it. Each invocation filters four outputs side by side, so that an
// input is loaded once for all four, and the quantities that are filtered together are the lanes of a vector.
const RADIUS: u32 = 5u;
const W0: f32 = 0.00102838;
const W1: f32 = 0.00759876;
const W2: f32 = 0.03600077;
const W3: f32 = 0.10936069;
const W4: f32 = 0.21300553;
const W5: f32 = 0.26601172;

// Weights of 14 successive inputs for the four outputs.
const T0 = vec4(W0, 0.0, 0.0, 0.0);
const T1 = vec4(W1, W0, 0.0, 0.0);
const T2 = vec4(W2, W1, W0, 0.0);
const T3 = vec4(W3, W2, W1, W0);
const T4 = vec4(W4, W3, W2, W1);
const T5 = vec4(W5, W4, W3, W2);
const T6 = vec4(W4, W5, W4, W3);
const T7 = vec4(W3, W4, W5, W4);
const T8 = vec4(W2, W3, W4, W5);
const T9 = vec4(W1, W2, W3, W4);
const T10 = vec4(W0, W1, W2, W3);
const T11 = vec4(0.0, W0, W1, W2);
const T12 = vec4(0.0, 0.0, W0, W1);
const T13 = vec4(0.0, 0.0, 0.0, W0);

// Filtered quantities of four outputs side by side.
struct Filtered {
    at: array<vec4<f32>, 4>,
}

fn add(sum: ptr<function, Filtered>, value: vec4<f32>, taps: vec4<f32>) {
    // The taps are constants: a zero one costs nothing.
    if taps.x != 0.0 {
        (*sum).at[0] += taps.x * value;
    }
    if taps.y != 0.0 {
        (*sum).at[1] += taps.y * value;
    }
    if taps.z != 0.0 {
        (*sum).at[2] += taps.z * value;
    }
    if taps.w != 0.0 {
        (*sum).at[3] += taps.w * value;
    }
}

// Four outputs of one column of `rows`, which each pass declares: [rows, 16 columns], filtered along rows. The first input is at `at`.
fn filter_column(at: u32) -> Filtered {
    var sum: Filtered;
    add(&sum, rows[at], T0);
    add(&sum, rows[at + 16u], T1);
    add(&sum, rows[at + 32u], T2);
    add(&sum, rows[at + 48u], T3);
    add(&sum, rows[at + 64u], T4);
    add(&sum, rows[at + 80u], T5);
    add(&sum, rows[at + 96u], T6);
    add(&sum, rows[at + 112u], T7);
    add(&sum, rows[at + 128u], T8);
    add(&sum, rows[at + 144u], T9);
    add(&sum, rows[at + 160u], T10);
    add(&sum, rows[at + 176u], T11);
    add(&sum, rows[at + 192u], T12);
    add(&sum, rows[at + 208u], T13);
    return sum;
}

// Pixels per row and per column of a plane that carries a border of RADIUS zeros and ends at whole tiles.
fn bordered(size: u32) -> u32 {
    return (size + 15u) / 16u * 16u + 2u * RADIUS;
}

// Weights of every part of the loss; host twin: `optimise::loss::LossSetup`.
struct LossSetup {
    width: u32,
    height: u32,
    // λ: share of SSIM.
    ssim_weight: f32,
    // λ_depth per metre; 0 without depth.
    depth_weight: f32,
    // Depth, metres, beyond which the weight falls with its square, as a sensor's precision does.
    precise_depth: f32,
    // Of the view's depth image, 0 to 1.
    depth_confidence: f32,
}

// What a residual of depth counts, as a share of `depth_weight`.
fn depth_precision(measured: f32) -> f32 {
    let ratio = setup.precise_depth / measured;
    return setup.depth_confidence * min(1.0, ratio * ratio);
}
