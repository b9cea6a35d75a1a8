// The recorded image as the step's loss has it, and the weights of the loss.

// Weights of every part of the loss; host twin: `render::layout::LossSetup`.
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
    // First pixel with a window, 0 or 1 along x and along y.
    phase_x: u32,
    phase_y: u32,
    // Pixels of the image for each of its windows: about four.
    pixels_per_window: f32,
    // Factors from the recorded image's colours to the map's.
    red_gain: f32,
    green_gain: f32,
    blue_gain: f32,
}

// Alpha is 1 where something was recorded, else 0.
fn is_recorded(packed: u32) -> bool {
    return packed > 0xffffffu;
}

// A pixel of the recorded image in the map's colours, 0 to 1; all lanes are 0 where nothing was recorded.
fn wanted_pixel(packed: u32) -> vec4<f32> {
    let gains = vec4(setup.red_gain, setup.green_gain, setup.blue_gain, 1.0);
    return min(unpack4x8unorm(select(0u, packed, is_recorded(packed))) * gains, vec4(1.0));
}

// What a residual of depth counts, as a share of `depth_weight`.
fn depth_precision(measured: f32) -> f32 {
    let ratio = setup.precise_depth / measured;
    return setup.depth_confidence * min(1.0, ratio * ratio);
}
