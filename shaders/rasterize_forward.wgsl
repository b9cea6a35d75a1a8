// Blends the tile's Gaussians front to back into colour, depth and transmittance (Kerbl et al. 2023, eq. 3). One workgroup a tile.

// [H, W] (r, g, b, Σ w z): colour over the background, depth weighted by what was blended.
@group(0) @binding(5) var<storage, read_write> color_depth: array<vec4<f32>>;
// [H, W] (transmittance, pairs of the tile's list up to and with the last one blended).
@group(0) @binding(6) var<storage, read_write> state: array<vec2<f32>>;

var<workgroup> finished: atomic<u32>;

// What a quad of pixels has blended so far.
struct Blended {
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
    transmittance: vec4<f32>,
    last: vec4<u32>,
    // Whether the pixel takes more.
    open: vec4<bool>,
}

@compute @workgroup_size(TILE_THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = linear_workgroup(workgroup, workgroups);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let range = ranges[tile];
    var quads: array<Quad, QUADS>;
    var blended: array<Blended, QUADS>;
    for (var q = 0u; q < QUADS; q++) {
        quads[q] = quad_of(view, tile, local * QUADS + q);
        blended[q].transmittance = vec4(1.0);
        blended[q].open = quads[q].inside;
    }
    var counted = false;

    for (var start = range.x; start < range.y; start += BATCH) {
        var open = vec4(false);
        for (var q = 0u; q < QUADS; q++) {
            open = open | blended[q].open;
        }
        if !counted && !any(open) {
            counted = true;
            atomicAdd(&finished, 1u);
        }
        workgroupBarrier();
        if workgroupUniformLoad(&finished) == TILE_THREADS {
            break;
        }
        load_batch(start, range.y, local);
        workgroupBarrier();
        let end = min(BATCH, range.y - start);
        for (var k = 0u; k < end; k++) {
            let mean = batch_mean[k];
            let shape = batch_whitening[k];
            let color = batch_color[k];
            for (var q = 0u; q < QUADS; q++) {
                var quad = blended[q];
                blend(mean, shape, color, start + k + 1u - range.x, quads[q], &quad);
                blended[q] = quad;
            }
        }
    }
    for (var q = 0u; q < QUADS; q++) {
        let done = blended[q];
        for (var p = 0; p < 4; p++) {
            if quads[q].inside[p] {
                let color = vec3(done.red[p], done.green[p], done.blue[p]) + done.transmittance[p] * view.background.xyz;
                color_depth[quads[q].index[p]] = vec4(color, done.depth[p]);
                state[quads[q].index[p]] = vec2(done.transmittance[p], bitcast<f32>(done.last[p]));
            }
        }
    }
}

// Blends one Gaussian, the `number`-th of the tile, into a quad.
fn blend(mean: vec4<f32>, shape: vec4<f32>, color: vec4<f32>, number: u32, quad: Quad, to: ptr<function, Blended>) {
    let distance = half_distance(mean.xy, shape.xyz, quad);
    let hit = (*to).open & (distance <= vec4(mean.w));
    if !any(hit) {
        return;
    }
    let alpha = min(vec4(ALPHA_MAX), shape.w * exp(-distance));
    let next = (*to).transmittance * (1.0 - alpha);
    let stop = hit & (next < vec4(TRANSMITTANCE_MIN));
    let taken = hit & !stop;
    (*to).open = (*to).open & !stop;
    let weight = select(vec4(0.0), alpha * (*to).transmittance, taken);
    (*to).red += weight * color.x;
    (*to).green += weight * color.y;
    (*to).blue += weight * color.z;
    (*to).depth += weight * mean.z;
    (*to).transmittance = select((*to).transmittance, next, taken);
    (*to).last = select((*to).last, vec4(number), taken);
}
