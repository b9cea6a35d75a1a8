// The same gradients as `rasterize_backward_pixels`, in the form that suits wide SIMD units (after Mallick et al. 2024, Taming 3DGS,
// but without their per-bucket checkpoints): each invocation keeps a Gaussian and its sums in registers, and the tile's quads of pixels
// pass by. At each step invocation i works on the quad that invocation i - 1 has just left, so that every quad meets the Gaussians
// in their order; an invocation that has seen all quads takes the Gaussian TILE_THREADS places further on, and no lane ever idles but
// at the ends of the list. QUADS is 1: there are as many quads as invocations.

// The quads' state, in workgroup memory.
var<workgroup> quads: array<PixelState, TILE_THREADS>;

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
    quads[local] = load_pixels(quad_of(view, tile, local));
    workgroupBarrier();
    let count = workgroupUniformLoad(&tile_last);
    let end = select(0u, count + TILE_THREADS - 1u, count > 0u);

    var mean = vec4(0.0);
    var shape = vec4(0.0);
    var color = vec4(0.0);
    var sum = PairGradient(vec4(0.0), vec4(0.0), vec4(0.0));
    for (var step = 0u; step < end; step++) {
        if step % TILE_THREADS == 0u && step < count {
            load_batch(range.x + step, range.x + min(step + TILE_THREADS, count), local);
            workgroupBarrier();
        }
        // Steps since invocation `local` began; it wraps before that, and is then beyond any list.
        let age = step - local;
        let turn = age % TILE_THREADS;
        let position = age - turn + local;
        if step >= local && position < count {
            if turn == 0u {
                mean = batch_mean[local];
                shape = batch_whitening[local];
                color = batch_color[local];
                sum = PairGradient(vec4(0.0), vec4(0.0), vec4(0.0));
            }
            var pixels = quads[turn];
            pass_gaussian(mean, shape, color, position, quad_of(view, tile, turn), &pixels, &sum);
            quads[turn].transmittance = pixels.transmittance;
            quads[turn].behind = pixels.behind;
            if turn == TILE_THREADS - 1u {
                let slot = sorted_slots[range.x + position];
                pair_gradients[slot * 3u] = sum.color_depth;
                pair_gradients[slot * 3u + 1u] = sum.first;
                pair_gradients[slot * 3u + 2u] = sum.second;
            }
        }
        workgroupBarrier();
    }
    clear_unblended(range.x + count, range.y, local);
}
