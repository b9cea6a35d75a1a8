// Gradient of the blended image with respect to each (Gaussian, tile) pair, written to the pair's own slot: no atomics, and the sum
// over a Gaussian's slots runs in a fixed order.
//
// This form keeps quads of pixels in each invocation while the Gaussians pass, and sums over the invocations. It suits narrow SIMD units
// (the software adapter); `rasterize_backward_splats` suits wide ones.

const CHUNK: u32 = 8u;
// [CHUNK, 3, TILE_THREADS] what each invocation adds to each pair of the chunk.
var<workgroup> partial: array<vec4<f32>, CHUNK * 3u * TILE_THREADS>;

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
    var pixels: array<PixelState, QUADS>;
    for (var q = 0u; q < QUADS; q++) {
        quads[q] = quad_of(view, tile, local * QUADS + q);
        pixels[q] = load_pixels(quads[q]);
    }
    workgroupBarrier();
    let blended_end = range.x + workgroupUniformLoad(&tile_last);

    for (var start = range.x; start < blended_end; start += BATCH) {
        workgroupBarrier();
        load_batch(start, blended_end, local);
        workgroupBarrier();
        let end = min(BATCH, blended_end - start);
        for (var chunk = 0u; chunk < end; chunk += CHUNK) {
            let count = min(CHUNK, end - chunk);
            for (var k = 0u; k < count; k++) {
                let mean = batch_mean[chunk + k];
                let shape = batch_whitening[chunk + k];
                let color = batch_color[chunk + k];
                var sum = PairGradient(vec4(0.0), vec4(0.0), vec4(0.0));
                for (var q = 0u; q < QUADS; q++) {
                    var quad = pixels[q];
                    pass_gaussian(mean, shape, color, start + chunk + k - range.x, quads[q], &quad, &sum);
                    pixels[q] = quad;
                }
                let to = k * 3u * TILE_THREADS + local;
                partial[to] = sum.color_depth;
                partial[to + TILE_THREADS] = sum.first;
                partial[to + 2u * TILE_THREADS] = sum.second;
            }
            workgroupBarrier();
            for (var item = local; item < count * 3u; item += TILE_THREADS) {
                var sum = vec4(0.0);
                for (var i = 0u; i < TILE_THREADS; i++) {
                    sum += partial[item * TILE_THREADS + i];
                }
                let slot = sorted_slots[start + chunk + item / 3u];
                pair_gradients[slot * 3u + item % 3u] = sum;
            }
            workgroupBarrier();
        }
    }
    clear_unblended(blended_end, range.y, local);
}
