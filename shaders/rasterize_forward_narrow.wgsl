// The forward pass of `shared/blend`.

var<workgroup> finished: atomic<u32>;
// The longest list of the workgroup's tiles.
var<workgroup> longest: atomic<u32>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let place = place_of(linear_workgroup(workgroup), local);
    let block = place.block;
    let count = place.range.y - place.range.x;
    if local == 0u {
        atomicStore(&finished, 0u);
        atomicStore(&longest, 0u);
    }
    workgroupBarrier();
    atomicMax(&longest, count);
    var blended: array<Blended, STRIPS>;
    for (var s = 0u; s < STRIPS; s++) {
        blended[s].transmittance = vec4(1.0);
        blended[s].open = block.columns & vec4(s < block.rows);
    }
    var counted = false;

    let end = workgroupUniformLoad(&longest);
    for (var start = 0u; start < end; start += TILE_BATCH) {
        var open = vec4(false);
        for (var s = 0u; s < STRIPS; s++) {
            open = open | blended[s].open;
        }
        if !counted && (!any(open) || start >= count) {
            counted = true;
            atomicAdd(&finished, 1u);
        }
        workgroupBarrier();
        if workgroupUniformLoad(&finished) == THREADS {
            break;
        }
        load_batch(place, start, count);
        workgroupBarrier();
        for (var k = start; k < min(count, start + TILE_BATCH); k++) {
            let gaussian = kept_listed(place.member * TILE_BATCH + k - start, k);
            let dx = block.x - gaussian.mean.x;
            for (var s = 0u; s < STRIPS; s++) {
                var strip = blended[s];
                blend(gaussian, dx, block.y + f32(s) - gaussian.mean.y, &strip);
                blended[s] = strip;
            }
        }
    }
    for (var s = 0u; s < STRIPS; s++) {
        let done = blended[s];
        for (var p = 0u; p < 4u; p++) {
            if block.columns[p] && s < block.rows {
                let at = block.first + s * view.width + p;
                let color = vec3(done.red[p], done.green[p], done.blue[p]) + done.transmittance[p] * view.background.xyz;
                color_depth[at] = vec4(color, done.depth[p]);
                //# planar
                color_depth[view.width * view.height + at] =
                    vec4(done.slope_x[p], done.slope_y[p], done.squared_depth[p], done.median_depth[p]);
                //# end
                state[at] = vec2(bitcast<u32>(done.transmittance[p]), done.last[p]);
            }
        }
    }
}
