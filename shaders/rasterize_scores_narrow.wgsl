// The scores of `shared/tile_scores`, summed as `rasterize_backward_narrow` sums its gradients.

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

    for (var start = 0u; start < end; start += TILE_BATCH) {
        workgroupBarrier();
        load_batch(place, start, blended);
        workgroupBarrier();
        for (var chunk = start; chunk < min(end, start + TILE_BATCH); chunk += CHUNK) {
            let chunk_end = min(blended, chunk + CHUNK);
            for (var k = chunk; k < chunk_end; k++) {
                let gaussian = kept_listed(place.member * TILE_BATCH + k - start, k);
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
    clear_unblended(place, blended, 2u);
}

// 1 where the error of a strip's pixel exceeds the threshold.
fn error_pixels(place: Place, strip: u32, threshold: f32) -> vec4<f32> {
    var is_error = vec4(0.0);
    for (var p = 0u; p < 4u; p++) {
        if place.block.columns[p] && strip < place.block.rows {
            is_error[p] = error_pixel(place.block.first + strip * view.width + p, threshold);
        }
    }
    return is_error;
}

fn hidden_gradient(pixel: u32) -> f32 {
    return 0.0;
}
