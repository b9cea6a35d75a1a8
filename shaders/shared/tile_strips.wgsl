// The narrow form's backward passes: blocks of pixels stay in an invocation while the Gaussians pass, and their sums run over the tile's invocations. It suits
// narrow SIMD units (the software adapter).

// [intersections, 3] what is summed, see who includes it.
@group(0) @binding(8) var<storage, read_write> intersection_gradients: array<vec4<f32>>;

// Gaussians that are summed at a time.
const CHUNK: u32 = 8u;

// How many Gaussians of each tile's list were blended, and the most of these.
var<workgroup> tile_last: array<atomic<u32>, GROUP_TILES>;
var<workgroup> longest: atomic<u32>;

// Before the pixels are loaded: workgroup memory holds anything.
fn clear_last(local: u32) {
    if local < GROUP_TILES {
        atomicStore(&tile_last[local], 0u);
    }
    if local == 0u {
        atomicStore(&longest, 0u);
    }
    workgroupBarrier();
}

// A strip's pixels; counts them in `tile_last` and `longest`.
fn load_pixels(place: Place, strip: u32) -> PixelState {
    var pixels: PixelState;
    pixels.transmittance = vec4(1.0);
    for (var p = 0u; p < 4u; p++) {
        if !place.block.columns[p] || strip >= place.block.rows {
            continue;
        }
        let i = place.block.first + strip * view.width + p;
        let gradient = image_gradients[i];
        pixels.red[p] = gradient.x;
        pixels.green[p] = gradient.y;
        pixels.blue[p] = gradient.z;
        pixels.depth[p] = gradient.w + hidden_gradient(i);
        pixels.last[p] = state[i].y;
        pixels.behind[p] = behind_all(i);
        //# planar
        let by_surface = image_gradients[2u * view.width * view.height + i];
        pixels.slope_x[p] = by_surface.x;
        pixels.slope_y[p] = by_surface.y;
        pixels.squared_depth[p] = by_surface.z;
        //# end
    }
    let last = max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w));
    atomicMax(&tile_last[place.member], last);
    atomicMax(&longest, last);
    return pixels;
}

// Zeroes the sums of the intersections behind every pixel's last contributor: they were not blended.
fn clear_unblended(place: Place, blended: u32, vectors: u32) {
    for (var i = place.range.x + blended + place.thread; i < place.range.y; i += TILE_THREADS) {
        let slot = sorted_slots[i];
        for (var v = 0u; v < vectors; v++) {
            intersection_gradients[slot * 3u + v] = vec4(0.0);
        }
    }
}
