// The forward pass of `shared/blend`: a workgroup takes a tile, and an invocation one pixel of each sub-tile.

// Gaussians in workgroup memory at a time; BUCKET is a multiple.
const BATCH: u32 = SUBTILE_PIXELS;
// The sub-tiles that each Gaussian of the batch reaches.
var<workgroup> batch_reach: array<u32, BATCH>;
// A bit for each sub-tile whose pixels take more.
var<workgroup> open_subtiles: atomic<u32>;

@compute @workgroup_size(SUBTILE_PIXELS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = linear_workgroup(workgroup);
    if tile >= view.tiles_x * view.tiles_y {
        return;
    }
    let corner = corner_of(tile);
    let at = vec2<f32>(pixel_of(corner, 0u, local));
    let range = ranges[tile];
    let count = range.y - range.x;
    // Only as constants may the sub-tiles name registers.
    var blended_0 = nothing_blended(corner, 0u, local);
    var blended_1 = nothing_blended(corner, 1u, local);
    var blended_2 = nothing_blended(corner, 2u, local);
    var blended_3 = nothing_blended(corner, 3u, local);
    var ahead = batch_ahead(range.x, 0u, count, local);
    for (var start = 0u; start < count; start += BATCH) {
        if local == 0u {
            atomicStore(&open_subtiles, 0u);
        }
        workgroupBarrier();
        let is_open = vec4(blended_0.open, blended_1.open, blended_2.open, blended_3.open);
        atomicOr(&open_subtiles, dot(select(vec4(0u), vec4(1u, 2u, 4u, 8u), is_open), vec4(1u)));
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
            keep_checkpoint(bucket, local, blended_0);
            keep_checkpoint(bucket, SUBTILE_PIXELS + local, blended_1);
            keep_checkpoint(bucket, 2u * SUBTILE_PIXELS + local, blended_2);
            keep_checkpoint(bucket, 3u * SUBTILE_PIXELS + local, blended_3);
        }
        for (var k = 0u; k < min(BATCH, count - start); k++) {
            let reached = batch_reach[k] & open;
            if reached == 0u {
                continue;
            }
            let gaussian = kept_listed(k, start + k);
            let d = at - gaussian.mean.xy;
            if (reached & 1u) != 0u {
                blend(gaussian, d.x, d.y, &blended_0);
            }
            if (reached & 2u) != 0u {
                blend(gaussian, at.x + ACROSS - gaussian.mean.x, d.y, &blended_1);
            }
            if (reached & 4u) != 0u {
                blend(gaussian, d.x, at.y + DOWN - gaussian.mean.y, &blended_2);
            }
            if (reached & 8u) != 0u {
                blend(gaussian, at.x + ACROSS - gaussian.mean.x, at.y + DOWN - gaussian.mean.y, &blended_3);
            }
        }
        workgroupBarrier();
    }
    store(pixel_of(corner, 0u, local), blended_0);
    store(pixel_of(corner, 1u, local), blended_1);
    store(pixel_of(corner, 2u, local), blended_2);
    store(pixel_of(corner, 3u, local), blended_3);
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
