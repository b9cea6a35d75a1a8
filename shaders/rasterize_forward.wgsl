// Blends the tile's Gaussians front to back into colour, depth and transmittance (Kerbl et al. 2023, eq. 3). One workgroup a tile.

// [H, W] (r, g, b, Σ w z): colour over the background, depth weighted by what was blended.
@group(0) @binding(5) var<storage, read_write> color_depth: array<vec4<f32>>;
// [H, W] (transmittance, pairs of the tile's list up to and with the last one blended).
@group(0) @binding(6) var<storage, read_write> state: array<vec2<f32>>;

var<workgroup> finished: atomic<u32>;

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
    let quad = quad_of(view, tile, local);
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var depth = vec4(0.0);
    var transmittance = vec4(1.0);
    var active_ = quad.inside;
    var last = vec4(0u);
    var counted = false;

    for (var start = range.x; start < range.y; start += BATCH) {
        if !counted && !any(active_) {
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
            let distance = half_distance(mean.xy, shape.xyz, quad);
            let hit = active_ & (distance <= vec4(mean.w));
            if !any(hit) {
                continue;
            }
            let alpha = min(vec4(ALPHA_MAX), shape.w * exp(-distance));
            let next = transmittance * (1.0 - alpha);
            let stop = hit & (next < vec4(TRANSMITTANCE_MIN));
            let blend = hit & !stop;
            active_ = active_ & !stop;
            let weight = select(vec4(0.0), alpha * transmittance, blend);
            let color = batch_color[k];
            red += weight * color.x;
            green += weight * color.y;
            blue += weight * color.z;
            depth += weight * mean.z;
            transmittance = select(transmittance, next, blend);
            last = select(last, vec4(start + k + 1u - range.x), blend);
        }
    }
    for (var p = 0; p < 4; p++) {
        if quad.inside[p] {
            let color = vec3(red[p], green[p], blue[p]) + transmittance[p] * view.background.xyz;
            color_depth[quad.index[p]] = vec4(color, depth[p]);
            state[quad.index[p]] = vec2(transmittance[p], bitcast<f32>(last[p]));
        }
    }
}
