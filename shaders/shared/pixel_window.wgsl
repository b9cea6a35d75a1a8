// The 11-tap Gaussian window (σ = 1.5 pixels) of SSIM (Wang et al. 2004), zero beyond the image, as both loss passes use it. A step evaluates
// a quarter of the windows: an unbiased estimate of the mean over all. Each invocation filters four outputs side by side, so that an input is
// loaded once for all four, and the quantities that are filtered together are the lanes of a vector.
const RADIUS: u32 = 5u;
const W0: f32 = 0.00102838;
const W1: f32 = 0.00759876;
const W2: f32 = 0.03600077;
const W3: f32 = 0.10936069;
const W4: f32 = 0.21300553;
const W5: f32 = 0.26601172;

// Windows lie at every second pixel of every second row, from the step's phase on. Weights of 17 successive pixels for four windows:
const T0 = vec4(W0, 0.0, 0.0, 0.0);
const T1 = vec4(W1, 0.0, 0.0, 0.0);
const T2 = vec4(W2, W0, 0.0, 0.0);
const T3 = vec4(W3, W1, 0.0, 0.0);
const T4 = vec4(W4, W2, W0, 0.0);
const T5 = vec4(W5, W3, W1, 0.0);
const T6 = vec4(W4, W4, W2, W0);
const T7 = vec4(W3, W5, W3, W1);
const T8 = vec4(W2, W4, W4, W2);
const T9 = vec4(W1, W3, W5, W3);
const T10 = vec4(W0, W2, W4, W4);
const T11 = vec4(0.0, W1, W3, W5);
const T12 = vec4(0.0, W0, W2, W4);
const T13 = vec4(0.0, 0.0, W1, W3);
const T14 = vec4(0.0, 0.0, W0, W2);
const T15 = vec4(0.0, 0.0, 0.0, W1);
const T16 = vec4(0.0, 0.0, 0.0, W0);

// and of 7 successive windows for four pixels, from even pixels on (E) and from odd ones (O).
const E0 = vec4(W1, W0, 0.0, 0.0);
const E1 = vec4(W3, W2, W1, W0);
const E2 = vec4(W5, W4, W3, W2);
const E3 = vec4(W3, W4, W5, W4);
const E4 = vec4(W1, W2, W3, W4);
const E5 = vec4(0.0, W0, W1, W2);
const E6 = vec4(0.0, 0.0, 0.0, W0);
const O0 = vec4(W0, 0.0, 0.0, 0.0);
const O1 = vec4(W2, W1, W0, 0.0);
const O2 = vec4(W4, W3, W2, W1);
const O3 = vec4(W4, W5, W4, W3);
const O4 = vec4(W2, W3, W4, W5);
const O5 = vec4(W0, W1, W2, W3);
const O6 = vec4(0.0, 0.0, W0, W1);

// Filtered quantities of four outputs side by side.
struct Filtered {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
    d: vec4<f32>,
}

fn add(sum: ptr<function, Filtered>, value: vec4<f32>, taps: vec4<f32>) {
    // The taps are constants: a zero one costs nothing.
    if taps.x != 0.0 {
        (*sum).a += taps.x * value;
    }
    if taps.y != 0.0 {
        (*sum).b += taps.y * value;
    }
    if taps.z != 0.0 {
        (*sum).c += taps.z * value;
    }
    if taps.w != 0.0 {
        (*sum).d += taps.w * value;
    }
}

// Windows of a row or column, with a border of three on each side; the image's end is that of its last 16 pixels.
const WINDOW_BORDER: u32 = 3u;

fn bordered_windows(size: u32) -> u32 {
    return (size + 15u) / 16u * 8u + 2u * WINDOW_BORDER;
}
