// The same gradients as `rasterize_backward_narrow`, in the form that suits wide SIMD units (after Mallick et al. 2024, Taming 3DGS,
// but without their per-bucket checkpoints): each invocation keeps a Gaussian and its sums in registers, and the tile's strips of pixels
// pass by. At each step invocation i works on the strip that invocation i - 1 has just left, so that every strip meets the Gaussians
// in their order; an invocation that has seen all strips takes the Gaussian TILE_THREADS places further on, and no lane ever idles but
// at the ends of the list. STRIPS and GROUP_TILES are 1: there are as many strips as invocations, all of one tile.

// The strips' state, in workgroup memory.
var<workgroup> strips: array<PixelState, TILE_THREADS>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let place = place_of(linear_workgroup(workgroup), local);
    strips[local] = load_pixels(place, 0u);
    workgroupBarrier();
    let count = workgroupUniformLoad(&longest);
    let end = select(0u, count + TILE_THREADS - 1u, count > 0u);

    var mean = vec4(0.0);
    var shape = vec4(0.0);
    var color = vec4(0.0);
    var sum = IntersectionGradient(vec4(0.0), vec4(0.0), vec4(0.0));
    for (var step = 0u; step < end; step++) {
        if step % TILE_THREADS == 0u && step < count {
            load_batch(place, step, min(step + TILE_THREADS, count));
            workgroupBarrier();
        }
        // Steps since invocation `local` began; it wraps before that, and is then beyond any list.
        let age = step - local;
        let turn = age % TILE_THREADS;
        let position = age - turn + local;
        if step >= local && position < count {
            if turn == 0u {
                mean = batch_mean[local];
                shape = batch_conic_factor[local];
                color = batch_color[local];
                sum = IntersectionGradient(vec4(0.0), vec4(0.0), vec4(0.0));
            }
            let block = block_of(place.tile, turn);
            var pixels = strips[turn];
            add_gradient(block.x - mean.x, block.y - mean.y, mean, shape, color, position, &pixels, &sum);
            strips[turn].transmittance = pixels.transmittance;
            strips[turn].behind = pixels.behind;
            if turn == TILE_THREADS - 1u {
                let slot = sorted_slots[place.range.x + position];
                intersection_gradients[slot * 3u] = before_clamp(color, sum.color_depth);
                intersection_gradients[slot * 3u + 1u] = sum.first;
                intersection_gradients[slot * 3u + 2u] = sum.second;
            }
        }
        workgroupBarrier();
    }
    clear_unblended(place, count);
}
