// The scores of `shared/tile_scores`, summed as `rasterize_backward_narrow` sums its gradients.

const CHUNK: u32 = 8u;
// [GROUP_TILES, CHUNK, 2, TILE_THREADS] what each invocation adds to each intersection of the chunk.
var<workgroup> partial: array<vec4<f32>, CHUNK * 2u * THREADS>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let place = place_of(linear_workgroup(workgroup), local);
    let block = place.block;
    clear_last(local);
    let threshold = error_threshold();
    var pixels: array<PixelState, STRIPS>;
    var is_error: array<vec4<f32>, STRIPS>;
    for (var s = 0u; s < STRIPS; s++) {
        pixels[s] = load_pixels(place, s);
        is_error[s] = error_pixels(place, s, threshold);
    }
    workgroupBarrier();
    let end = workgroupUniformLoad(&longest);
    let blended = atomicLoad(&tile_last[place.member]);
    let partials = place.member * CHUNK * 2u * TILE_THREADS;

    for (var start = 0u; start < end; start += BATCH) {
        workgroupBarrier();
        load_batch(place, start, blended);
        workgroupBarrier();
        for (var chunk = start; chunk < min(end, start + BATCH); chunk += CHUNK) {
            let chunk_end = min(blended, chunk + CHUNK);
            for (var k = chunk; k < chunk_end; k++) {
                let at = place.member * BATCH + k - start;
                let gaussian = listed(at, k);
                var sum = PairScore(vec4(0.0), vec4(0.0));
                for (var s = 0u; s < STRIPS; s++) {
                    var strip = pixels[s];
                    add_score(gaussian, block.x, block.y + f32(s), is_error[s], &strip, &sum);
                    pixels[s] = strip;
                }
                let to = partials + (k - chunk) * 2u * TILE_THREADS + place.thread;
                partial[to] = sum.seen;
                partial[to + TILE_THREADS] = sum.gradient;
            }
            workgroupBarrier();
            for (var item = place.thread; chunk + item / 2u < chunk_end; item += TILE_THREADS) {
                var sum = vec4(0.0);
                var largest = 0.0;
                for (var i = 0u; i < TILE_THREADS; i++) {
                    let part = partial[partials + item * TILE_THREADS + i];
                    sum += part;
                    largest = max(largest, part.z);
                }
                if item % 2u == 0u {
                    sum.z = largest;
                }
                let slot = sorted_slots[place.range.x + chunk + item / 2u];
                intersection_gradients[slot * 3u + item % 2u] = sum;
            }
            workgroupBarrier();
        }
    }
    clear_unblended(place, blended);
}

// Intersections behind every pixel's last contributor were not blended.
fn clear_unblended(place: Place, blended: u32) {
    for (var i = place.range.x + blended + place.thread; i < place.range.y; i += TILE_THREADS) {
        let slot = sorted_slots[i];
        intersection_gradients[slot * 3u] = vec4(0.0);
        intersection_gradients[slot * 3u + 1u] = vec4(0.0);
    }
}
