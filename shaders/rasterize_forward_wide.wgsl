// The forward pass of `shared/blend`: a workgroup takes a tile, one half of its invocations the upper sub-tiles, the other the lower ones; an invocation has one
// pixel of each.

const THREADS: u32 = 2u * SUBTILE_PIXELS;
// Gaussians in workgroup memory at a time.
const BATCH: u32 = 48u;
const_assert BUCKET % BATCH == 0u;
// As many sub-tiles as the halves take.
const_assert SUBTILES == 4u;
// The sub-tiles that each Gaussian of the batch reaches.
var<workgroup> batch_reach: array<u32, BATCH>;
// A bit for each sub-tile whose pixels take more.
var<workgroup> open_subtiles: atomic<u32>;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let corner = corner_of(tile);
    let lane = local % SUBTILE_PIXELS;
    let left = local / SUBTILE_PIXELS * SUBTILES_ACROSS;
    let at = vec2<f32>(pixel_of(corner, left, lane));
    let range = ranges[tile];
    let count = range.y - range.x;
    // Only as constants may the sub-tiles name registers.
    var blended_left = nothing_blended(corner, left, lane);
    var blended_right = nothing_blended(corner, left + 1u, lane);
    var ahead = batch_ahead(range.x, 0u, count, local);
    for (var start = 0u; start < count; start += BATCH) {
        if local == 0u {
            atomicStore(&open_subtiles, 0u);
        }
        workgroupBarrier();
        atomicOr(&open_subtiles, (select(0u, 1u, blended_left.open) | select(0u, 2u, blended_right.open)) << left);
        if local < BATCH && start + local < count {
            keep_listed(local, ahead);
            batch_reach[local] = subtiles_of(corner, ahead);
        }
        let open = workgroupUniformLoad(&open_subtiles);
        if open == 0u {
            break;
        }
        ahead = batch_ahead(range.x, start + BATCH, count, local);
        if start > 0u && start % BUCKET == 0u {
            let bucket = (range.x + start) / BUCKET;
            keep_checkpoint(bucket, left * SUBTILE_PIXELS + lane, blended_left);
            keep_checkpoint(bucket, (left + 1u) * SUBTILE_PIXELS + lane, blended_right);
        }
        for (var k = 0u; k < min(BATCH, count - start); k++) {
            let reached = ((batch_reach[k] & open) >> left) & 3u;
            if reached == 0u {
                continue;
            }
            let gaussian = kept_listed(k, start + k);
            let dy = at.y - gaussian.mean.y;
            if (reached & 1u) != 0u {
                blend(gaussian, at.x - gaussian.mean.x, dy, &blended_left);
            }
            if (reached & 2u) != 0u {
                blend(gaussian, at.x + ACROSS - gaussian.mean.x, dy, &blended_right);
            }
        }
        workgroupBarrier();
    }
    store(pixel_of(corner, left, lane), blended_left);
    store(pixel_of(corner, left + 1u, lane), blended_right);
}

fn nothing_blended(corner: vec2<u32>, subtile: u32, lane: u32) -> Blended {
    var blended: Blended;
    blended.transmittance = 1.0;
    blended.open = is_on_image(pixel_of(corner, subtile, lane));
    return blended;
}

fn store(pixel: vec2<u32>, done: Blended) {
    if !is_on_image(pixel) {
        return;
    }
    let at = pixel.y * view.width + pixel.x;
    color_depth[at] = vec4(vec3(done.red, done.green, done.blue) + done.transmittance * view.background.xyz, done.depth);
    //# planar
    color_depth[view.width * view.height + at] = vec4(done.slope_x, done.slope_y, done.squared_depth, done.median_depth);
    //# end
    state[at] = vec2(bitcast<u32>(done.transmittance), done.last);
}

// Where a bucket of BUCKET Gaussians begins within a tile's list, what a pixel has blended before it.
fn keep_checkpoint(bucket: u32, pixel: u32, blended: Blended) {
    keep(bucket, 0u, pixel, blended.red);
    keep(bucket, 1u, pixel, blended.green);
    keep(bucket, 2u, pixel, blended.blue);
    keep(bucket, 3u, pixel, blended.depth);
    keep(bucket, 4u, pixel, blended.transmittance);
    //# planar
    keep(bucket, 5u, pixel, blended.slope_x);
    keep(bucket, 6u, pixel, blended.slope_y);
    keep(bucket, 7u, pixel, blended.squared_depth);
    //# end
}

fn keep(bucket: u32, plane: u32, pixel: u32, value: f32) {
    color_depth[checkpoint_of(bucket, plane, pixel)][pixel % 4u] = value;
}
