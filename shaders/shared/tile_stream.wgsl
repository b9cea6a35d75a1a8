// Passes a tile's pixels by its Gaussians, in the form that suits wide SIMD units (after Mallick et al. 2024, Taming 3DGS): each invocation keeps a
// Gaussian in registers, and the tile's strips of pixels pass by. At each step invocation i works on the strip that invocation i - 1 has just left, so that
// every strip meets the Gaussians in their order; an invocation that has seen all strips takes the Gaussian TILE_THREADS places further on. A workgroup
// takes one bucket, BUCKET Gaussians of a tile's list, from the pixels' state that the forward pass left at its start: no list is longer than that.
// STRIPS and GROUP_TILES are 1: there are as many strips as invocations, all of one tile.
//
// Who includes it says what is summed: `load_strip`, `begin_sum`, `add_strip`, `store_sum`, `clear_sum`.

// The strips' state, in workgroup memory.
var<workgroup> strips: array<PixelState, TILE_THREADS>;

// A part of a tile's list.
struct Bucket {
    tile: u32,
    // From the tile's first intersection on.
    start: u32,
    // Whether there is one.
    is_there: bool,
}

// The first buckets of all tiles, then the later ones. Of these at most one begins within BUCKET places of the sorted list, in the tile that holds the
// first of these places: a tile's second bucket begins BUCKET places after its list.
fn bucket_of(group: u32) -> Bucket {
    let tiles = view.tiles_x * view.tiles_y;
    if group < tiles {
        return Bucket(group, 0u, true);
    }
    let place = (group - tiles) * BUCKET;
    var low = 0u;
    var high = tiles;
    while low < high {
        let middle = (low + high) / 2u;
        let ends_before = ranges[middle].y <= place;
        low = select(low, middle + 1u, ends_before);
        high = select(middle, high, ends_before);
    }
    let tile = min(low, tiles - 1u);
    let range = ranges[tile];
    let start = (max(place, range.x) - range.x + BUCKET - 1u) / BUCKET * BUCKET;
    return Bucket(tile, start, low < tiles && start > 0u && range.x + start < range.y);
}

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let bucket = bucket_of(linear_workgroup(workgroup));
    if !bucket.is_there {
        return;
    }
    clear_last(local);
    let range = ranges[bucket.tile];
    let first = range.x + bucket.start;
    let place = place_of(bucket.tile, local);
    var pixels = load_pixels(place, 0u);
    if bucket.start > 0u {
        resume(&pixels, first / BUCKET, local);
    }
    strips[local] = pixels;
    load_strip(place, local);
    let blended = workgroupUniformLoad(&longest);
    // Of the bucket: its Gaussians, those that were blended, and the steps it takes.
    let length = min(range.y - first, BUCKET);
    let count = min(max(blended, bucket.start) - bucket.start, length);
    let end = select(0u, count + TILE_THREADS - 1u, count > 0u);

    var gaussian: Listed;
    var next: Listed;
    for (var step = 0u; step < end; step++) {
        if step % TILE_THREADS == 0u && step + local < count {
            let i = slot_gaussians[sorted_slots[first + step + local]];
            next.mean = projected[PROJECTED * i];
            next.shape = projected[PROJECTED * i + 1u];
            next.color = projected[PROJECTED * i + 2u];
            next.position = bucket.start + step + local;
            //# planar
            next.slope = projected[PROJECTED * i + 3u].xy;
            //# end
        }
        // Steps since invocation `local` began; it wraps before that, and is then beyond any list.
        let age = step - local;
        let turn = age % TILE_THREADS;
        let position = age - turn + local;
        if step >= local && position < count {
            if turn == 0u {
                gaussian = next;
                begin_sum();
            }
            let block = block_of(place.tile, turn);
            var passing = strips[turn];
            add_strip(gaussian, block.x, block.y, turn, &passing);
            strips[turn].transmittance = passing.transmittance;
            strips[turn].behind = passing.behind;
            if turn == TILE_THREADS - 1u {
                store_sum(sorted_slots[first + position], gaussian.color);
            }
        }
        workgroupBarrier();
    }
    // Intersections behind every pixel's last contributor were not blended.
    for (var k = count + local; k < length; k += TILE_THREADS) {
        clear_sum(sorted_slots[first + k]);
    }
}

// From the checkpoint (see `rasterize_forward`), takes a strip to where the forward pass was at the start of the bucket.
fn resume(pixels: ptr<function, PixelState>, bucket: u32, local: u32) {
    let at = IMAGE_PLANES * view.width * view.height + bucket * CHECKPOINT * TILE_THREADS + local;
    let red = color_depth[at] * (*pixels).red;
    let green = color_depth[at + TILE_THREADS] * (*pixels).green;
    let blue = color_depth[at + 2u * TILE_THREADS] * (*pixels).blue;
    let depth = color_depth[at + 3u * TILE_THREADS] * (*pixels).depth;
    (*pixels).behind -= red + green + blue + depth;
    //# planar
    let slope_x = color_depth[at + 5u * TILE_THREADS] * (*pixels).slope_x;
    let slope_y = color_depth[at + 6u * TILE_THREADS] * (*pixels).slope_y;
    (*pixels).behind -= slope_x + slope_y + color_depth[at + 7u * TILE_THREADS] * (*pixels).squared_depth;
    //# end
    (*pixels).transmittance = color_depth[at + 4u * TILE_THREADS];
}
