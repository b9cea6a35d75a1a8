// Blends the tiles' Gaussians front to back into colour, depth and transmittance (Kerbl et al. 2023, eq. 3).

// [H, W] (r, g, b, Σ w z): colour over the background, depth weighted by what was blended. Of a planar surface, depth is that of each Gaussian's plane at the
// pixel, and [H, W] (Σ w slope x, Σ w slope y, Σ w z², median depth) follows. Behind it, in the wide form, checkpoints for the backward pass,
// [buckets, CHECKPOINT, TILE_THREADS]: where a bucket of BUCKET Gaussians begins within a tile's list, what each strip has blended before it: red, green, blue,
// depth, transmittance, and of a planar surface both slopes and z². Its number is its first place in the sorted list over BUCKET.
@group(0) @binding(5) var<storage, read_write> color_depth: array<vec4<f32>>;
// [H, W] (bits of the transmittance, intersections of the tile's list up to and with the last one blended).
@group(0) @binding(6) var<storage, read_write> state: array<vec2<u32>>;

var<workgroup> finished: atomic<u32>;
// The longest list of the workgroup's tiles.
var<workgroup> longest: atomic<u32>;

// What a strip of pixels has blended so far.
struct Blended {
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
    //# planar
    slope_x: vec4<f32>,
    slope_y: vec4<f32>,
    squared_depth: vec4<f32>,
    // Depth of the Gaussian behind which less than half of the light is left.
    median_depth: vec4<f32>,
    //# end
    transmittance: vec4<f32>,
    last: vec4<u32>,
    // Whether the pixel takes more.
    open: vec4<bool>,
}

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let place = place_of(linear_workgroup(workgroup), local);
    let block = place.block;
    let count = place.range.y - place.range.x;
    if local == 0u {
        atomicStore(&finished, 0u);
        atomicStore(&longest, 0u);
    }
    workgroupBarrier();
    atomicMax(&longest, count);
    var blended: array<Blended, STRIPS>;
    for (var s = 0u; s < STRIPS; s++) {
        blended[s].transmittance = vec4(1.0);
        blended[s].open = block.columns & vec4(s < block.rows);
    }
    var counted = false;

    let end = workgroupUniformLoad(&longest);
    for (var start = 0u; start < end; start += BATCH) {
        var open = vec4(false);
        for (var s = 0u; s < STRIPS; s++) {
            open = open | blended[s].open;
        }
        if !counted && (!any(open) || start >= count) {
            counted = true;
            atomicAdd(&finished, 1u);
        }
        workgroupBarrier();
        if workgroupUniformLoad(&finished) == THREADS {
            break;
        }
        if STRIPS == 1u && start > 0u && start % BUCKET == 0u {
            let to = IMAGE_PLANES * view.width * view.height + (place.range.x + start) / BUCKET * CHECKPOINT * TILE_THREADS + place.thread;
            color_depth[to] = blended[0].red;
            color_depth[to + TILE_THREADS] = blended[0].green;
            color_depth[to + 2u * TILE_THREADS] = blended[0].blue;
            color_depth[to + 3u * TILE_THREADS] = blended[0].depth;
            color_depth[to + 4u * TILE_THREADS] = blended[0].transmittance;
            //# planar
            color_depth[to + 5u * TILE_THREADS] = blended[0].slope_x;
            color_depth[to + 6u * TILE_THREADS] = blended[0].slope_y;
            color_depth[to + 7u * TILE_THREADS] = blended[0].squared_depth;
            //# end
        }
        load_batch(place, start, count);
        workgroupBarrier();
        for (var k = start; k < min(count, start + BATCH); k++) {
            let at = place.member * BATCH + k - start;
            let mean = batch_mean[at];
            let shape = batch_conic_factor[at];
            let color = batch_color[at];
            let along = shape.x * (block.x - mean.x);
            for (var s = 0u; s < STRIPS; s++) {
                let dy = block.y + f32(s) - mean.y;
                let u = along + shape.y * dy;
                let v = shape.z * dy;
                var strip = blended[s];
                var depth = vec4(mean.z);
                //# planar
                let slope = batch_slope[at];
                depth += slope.x * (block.x - mean.x) + slope.y * dy;
                let before = strip.transmittance;
                //# end
                let weight = blend(u * u + v * v, mean.w, shape.w, color, depth, k + 1u, &strip);
                //# planar
                strip.slope_x += weight * slope.x;
                strip.slope_y += weight * slope.y;
                strip.squared_depth += weight * depth * depth;
                strip.median_depth = select(strip.median_depth, depth, (weight > vec4(0.0)) & (before > vec4(0.5)));
                //# end
                blended[s] = strip;
            }
        }
    }
    for (var s = 0u; s < STRIPS; s++) {
        let done = blended[s];
        for (var p = 0u; p < 4u; p++) {
            if block.columns[p] && s < block.rows {
                let at = block.first + s * view.width + p;
                let color = vec3(done.red[p], done.green[p], done.blue[p]) + done.transmittance[p] * view.background.xyz;
                color_depth[at] = vec4(color, done.depth[p]);
                //# planar
                color_depth[view.width * view.height + at] =
                    vec4(done.slope_x[p], done.slope_y[p], done.squared_depth[p], done.median_depth[p]);
                //# end
                state[at] = vec2(bitcast<u32>(done.transmittance[p]), done.last[p]);
            }
        }
    }
}

// Blends one Gaussian, the `number`-th of the tile, into a strip, and returns its weight there; `distance` is ½dᵀΣ⁻¹d: alpha is opacity·exp(-that), down to the
// cut. Nothing is left out by branches: the narrow form's adapters would run both sides.
fn blend(
    distance: vec4<f32>,
    cut: f32,
    opacity: f32,
    color: vec4<f32>,
    depth: vec4<f32>,
    number: u32,
    to: ptr<function, Blended>,
) -> vec4<f32> {
    let hit = (*to).open & (distance <= vec4(cut));
    let alpha = min(vec4(ALPHA_MAX), opacity * exp(-distance));
    let next = (*to).transmittance * (1.0 - alpha);
    let stop = hit & (next < vec4(TRANSMITTANCE_MIN));
    let taken = hit & !stop;
    (*to).open = (*to).open & !stop;
    let weight = select(vec4(0.0), alpha * (*to).transmittance, taken);
    (*to).red += weight * color.x;
    (*to).green += weight * color.y;
    (*to).blue += weight * color.z;
    (*to).depth += weight * depth;
    (*to).transmittance = select((*to).transmittance, next, taken);
    (*to).last = select((*to).last, vec4(number), taken);
    return weight;
}
