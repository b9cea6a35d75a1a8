// Gradient of the blended image with respect to each (Gaussian, tile) intersection, written to the intersection's own slot: no atomics, and the sum
// over a Gaussian's slots runs in a fixed order.

// [GROUP_TILES, CHUNK, 3, TILE_THREADS] what each invocation adds to each intersection of the chunk.
var<workgroup> partial: array<vec4<f32>, CHUNK * 3u * THREADS>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let place = place_of(linear_workgroup(workgroup), local);
    let block = place.block;
    clear_last(local);
    var pixels: array<PixelState, STRIPS>;
    for (var s = 0u; s < STRIPS; s++) {
        pixels[s] = load_pixels(place, s);
    }
    workgroupBarrier();
    let end = workgroupUniformLoad(&longest);
    let blended = atomicLoad(&tile_last[place.member]);
    let partials = place.member * CHUNK * 3u * TILE_THREADS;

    for (var start = 0u; start < end; start += TILE_BATCH) {
        workgroupBarrier();
        load_batch(place, start, blended);
        workgroupBarrier();
        for (var chunk = start; chunk < min(end, start + TILE_BATCH); chunk += CHUNK) {
            let chunk_end = min(blended, chunk + CHUNK);
            for (var k = chunk; k < chunk_end; k++) {
                let gaussian = kept_listed(place.member * TILE_BATCH + k - start, k);
                var sum = IntersectionGradient(vec4(0.0), vec4(0.0), vec4(0.0));
                for (var s = 0u; s < STRIPS; s++) {
                    var strip = pixels[s];
                    add_gradient(gaussian, block.x, block.y + f32(s), &strip, &sum);
                    pixels[s] = strip;
                }
                let to = partials + (k - chunk) * 3u * TILE_THREADS + place.thread;
                partial[to] = select(vec4(0.0), sum.color_depth, vec4(gaussian.color.xyz > vec3(0.0), true));
                partial[to + TILE_THREADS] = sum.first;
                partial[to + 2u * TILE_THREADS] = sum.second;
            }
            workgroupBarrier();
            for (var item = place.thread; chunk + item / 3u < chunk_end; item += TILE_THREADS) {
                var sum = vec4(0.0);
                for (var i = 0u; i < TILE_THREADS; i++) {
                    sum += partial[partials + item * TILE_THREADS + i];
                }
                let slot = sorted_slots[place.range.x + chunk + item / 3u];
                intersection_gradients[slot * 3u + item % 3u] = sum;
            }
            workgroupBarrier();
        }
    }
    clear_unblended(place, blended, 3u);
}

// What is blended into a hidden pixel has a gradient beyond any other, by which `project_backward` knows it.
fn hidden_gradient(pixel: u32) -> f32 {
    return image_gradients[view.width * view.height + pixel].z;
}
