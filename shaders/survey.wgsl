// What a new keyframe's exposure and insertion need of the map's render from there, instead of all its pixels.
struct SurveySetup {
    width: u32,
    height: u32,
    // Side of a cell, pixels; cells in a row and in all.
    cell: u32,
    columns: u32,
    cells: u32,
    // Every so many pixels, so many are sampled.
    sample_stride: u32,
    samples: u32,
    // See `InsertionConfig`.
    min_alpha: f32,
    depth_disagreement: f32,
}

@group(0) @binding(0) var<uniform> setup: SurveySetup;
// [H, W] rendered (r, g, b, Σ w z); (bits of the transmittance, -); the keyframe's depth in metres (0: not measured).
@group(0) @binding(1) var<storage, read> color_depth: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> state: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> target_depth: array<f32>;
// [cells] 16 bits each, two a word: mean brightness in steps of BRIGHTNESS_STEP, LACKS_CORNER, LACKS_CENTER.
@group(0) @binding(4) var<storage, read_write> cells: array<u32>;
// [samples] (red, green), (blue, alpha), 16 bits each for 0 to 1.
@group(0) @binding(5) var<storage, read_write> samples: array<vec2<u32>>;

fn alpha_at(pixel: u32) -> f32 {
    return 1.0 - bitcast<f32>(state[pixel].x);
}

// Whether the map lacks what the pixel shows: it is not covered, or lies behind the measured surface.
fn lacks(pixel: u32) -> bool {
    let alpha = alpha_at(pixel);
    let measured = target_depth[pixel];
    let expected = select(0.0, color_depth[pixel].w / alpha, alpha > 0.0);
    let is_behind = measured > 0.0 && expected - measured > setup.depth_disagreement * measured;
    return alpha < setup.min_alpha || is_behind;
}

fn survey_cell(i: u32) -> u32 {
    let corner = setup.cell * vec2(i % setup.columns, i / setup.columns);
    let last = vec2(setup.width, setup.height) - 1u;
    let end = min(corner + setup.cell, last + 1u);
    var sum = vec3(0.0);
    for (var y = corner.y; y < end.y; y++) {
        for (var x = corner.x; x < end.x; x++) {
            sum += color_depth[y * setup.width + x].xyz;
        }
    }
    let size = end - corner;
    let mean = (sum.x + sum.y + sum.z) / f32(3u * size.x * size.y);
    let steps = u32(clamp(mean / BRIGHTNESS_STEP, 0.0, f32(BRIGHTNESS_MASK)) + 0.5);
    let center = min(corner + setup.cell / 2u, last);
    let at_corner = select(0u, LACKS_CORNER, lacks(corner.y * setup.width + corner.x));
    let at_center = select(0u, LACKS_CENTER, lacks(center.y * setup.width + center.x));
    return min(steps, BRIGHTNESS_MASK) | at_corner | at_center;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i < setup.samples {
        let pixel = i * setup.sample_stride;
        let color = color_depth[pixel].xyz;
        samples[i] = vec2(pack2x16unorm(color.xy), pack2x16unorm(vec2(color.z, alpha_at(pixel))));
    }
    if 2u * i < setup.cells {
        var word = survey_cell(2u * i);
        if 2u * i + 1u < setup.cells {
            word |= survey_cell(2u * i + 1u) << 16u;
        }
        cells[i] = word;
    }
}
