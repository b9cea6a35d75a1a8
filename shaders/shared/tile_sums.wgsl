// The wide form's backward passes: an invocation has one pixel of each sub-tile, the Gaussians of a tile's list pass by, and what the pixels of a tile add to
// each is summed through workgroup memory. A workgroup takes one bucket, BUCKET Gaussians of the list, from what the forward pass left at its start: no list
// is longer than that. Nothing depends on how many lanes a SIMD unit has, and every sum runs in a fixed order.
//
// Who includes it says what is summed: VALUES values of a `Sum`, see `no_sum`, `begin`, `hidden_gradient`, `add_pixels`, `leave_sum`, `joined`, `whole`, `place_in_slot`.

// [intersections, 12] what is summed: three vectors of four.
@group(0) @binding(8) var<storage, read_write> intersection_sums: array<f32>;

// Gaussians in workgroup memory at a time: with 24, the backward pass takes 4 KiB.
const BATCH: u32 = 24u;
const_assert BUCKET % BATCH == 0u;
// As many sub-tiles as `main` names.
const_assert SUBTILES == 4u;
// Gaussians that are summed at a time.
const TOGETHER: u32 = 2u;
// An invocation sums one value: rows of this length lie in different banks.
const ROW: u32 = SUBTILE_PIXELS + 1u;
// Of the batch's Gaussians the slots, and in the highest bits the sub-tiles that each is blended into.
const REACH_SHIFT: u32 = 28u;
var<workgroup> batch_slot: array<u32, BATCH>;
// A bit for each that is blended.
var<workgroup> batch_blended: atomic<u32>;
// How many Gaussians of the tile's list were blended into each sub-tile.
var<workgroup> subtile_last: array<atomic<u32>, SUBTILES>;
// [TOGETHER, VALUES, ROW] what each invocation adds.
var<workgroup> partial: array<f32, TOGETHER * VALUES * ROW>;

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

@compute @workgroup_size(SUBTILE_PIXELS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let bucket = bucket_of(linear_workgroup(workgroup));
    if !bucket.is_there {
        return;
    }
    let range = ranges[bucket.tile];
    let first = range.x + bucket.start;
    let length = min(range.y - first, BUCKET);
    let corner = corner_of(bucket.tile);
    if local < SUBTILES {
        atomicStore(&subtile_last[local], 0u);
    }
    workgroupBarrier();
    begin(corner, local);
    let at = vec2<f32>(pixel_of(corner, 0u, local));
    // Only as constants may the sub-tiles name registers.
    var pixels_0 = load_pixel(corner, 0u, local, bucket.start, first / BUCKET);
    var pixels_1 = load_pixel(corner, 1u, local, bucket.start, first / BUCKET);
    var pixels_2 = load_pixel(corner, 2u, local, bucket.start, first / BUCKET);
    var pixels_3 = load_pixel(corner, 3u, local, bucket.start, first / BUCKET);

    var ahead = batch_ahead(first, 0u, length, local);
    for (var start = 0u; start < length; start += BATCH) {
        if local == 0u {
            atomicStore(&batch_blended, 0u);
        }
        workgroupBarrier();
        if local < BATCH && start + local < length {
            admit(ahead, corner, bucket.start + start + local, sorted_slots[first + start + local], local);
        }
        var left = workgroupUniformLoad(&batch_blended);
        ahead = batch_ahead(first, start + BATCH, length, local);
        while left != 0u {
            let k = firstTrailingBit(left);
            left &= left - 1u;
            // BATCH where there is none.
            let l = select(BATCH, firstTrailingBit(left), left != 0u);
            left &= left - 1u;
            for (var t = 0u; t < TOGETHER; t++) {
                let m = select(k, l, t > 0u);
                if m == BATCH {
                    continue;
                }
                let gaussian = kept_listed(m, bucket.start + start + m);
                let reached = batch_slot[m] >> REACH_SHIFT;
                var sum = no_sum();
                if (reached & 1u) != 0u {
                    add_pixels(gaussian, at.x, at.y, 0u, &pixels_0, &sum);
                }
                if (reached & 2u) != 0u {
                    add_pixels(gaussian, at.x + ACROSS, at.y, 1u, &pixels_1, &sum);
                }
                if (reached & 4u) != 0u {
                    add_pixels(gaussian, at.x, at.y + DOWN, 2u, &pixels_2, &sum);
                }
                if (reached & 8u) != 0u {
                    add_pixels(gaussian, at.x + ACROSS, at.y + DOWN, 3u, &pixels_3, &sum);
                }
                leave_sum(sum, t * VALUES * ROW + local);
            }
            workgroupBarrier();
            let m = select(k, l, local >= VALUES);
            if local < TOGETHER * VALUES && m != BATCH {
                let value = local % VALUES;
                var sum = partial[local * ROW];
                for (var i = 1u; i < SUBTILE_PIXELS; i++) {
                    sum = joined(sum, partial[local * ROW + i], value);
                }
                let slot = batch_slot[m] & ((1u << REACH_SHIFT) - 1u);
                intersection_sums[slot * 12u + place_in_slot(value)] = whole(sum, m, value);
            }
            workgroupBarrier();
        }
    }
}

// The pixel of this lane in a sub-tile, before the bucket that begins at `start` of the tile's list; counts it in `subtile_last`.
fn load_pixel(corner: vec2<u32>, subtile: u32, lane: u32, start: u32, bucket: u32) -> PixelState {
    let pixel = pixel_of(corner, subtile, lane);
    var loaded: PixelState;
    loaded.transmittance = 1.0;
    if !is_on_image(pixel) {
        return loaded;
    }
    let i = pixel.y * view.width + pixel.x;
    let gradient = image_gradients[i];
    loaded.red = gradient.x;
    loaded.green = gradient.y;
    loaded.blue = gradient.z;
    loaded.depth = gradient.w + hidden_gradient(i);
    loaded.last = state[i].y;
    loaded.behind = behind_all(i);
    //# planar
    let by_surface = image_gradients[2u * view.width * view.height + i];
    loaded.slope_x = by_surface.x;
    loaded.slope_y = by_surface.y;
    loaded.squared_depth = by_surface.z;
    //# end
    atomicMax(&subtile_last[subtile], loaded.last);
    if start > 0u {
        let p = subtile * SUBTILE_PIXELS + lane;
        let colors = kept(bucket, 0u, p) * loaded.red + kept(bucket, 1u, p) * loaded.green + kept(bucket, 2u, p) * loaded.blue;
        loaded.behind -= colors + kept(bucket, 3u, p) * loaded.depth;
        loaded.transmittance = kept(bucket, 4u, p);
        //# planar
        let slopes = kept(bucket, 5u, p) * loaded.slope_x + kept(bucket, 6u, p) * loaded.slope_y;
        loaded.behind -= slopes + kept(bucket, 7u, p) * loaded.squared_depth;
        //# end
    }
    return loaded;
}

fn kept(bucket: u32, plane: u32, pixel: u32) -> f32 {
    return color_depth[checkpoint_of(bucket, plane, pixel)][pixel % 4u];
}

// Puts a Gaussian of the tile's list into the batch; clears its sums where no sub-tile is left that it was blended into.
fn admit(listed: Listed, corner: vec2<u32>, position: u32, slot: u32, to: u32) {
    var reached = subtiles_of(corner, listed);
    for (var s = 0u; s < SUBTILES; s++) {
        if position >= atomicLoad(&subtile_last[s]) {
            reached &= ~(1u << s);
        }
    }
    keep_listed(to, listed);
    batch_slot[to] = slot | (reached << REACH_SHIFT);
    if reached != 0u {
        atomicOr(&batch_blended, 1u << to);
        return;
    }
    for (var v = 0u; v < VALUES; v++) {
        intersection_sums[slot * 12u + place_in_slot(v)] = 0.0;
    }
}
