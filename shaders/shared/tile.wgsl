// Tiles' lists of Gaussians, as the blending passes of both forms see them. What they do to pixels is written once, over `Pixels`: four side by side in the
// narrow form, one in the wide form. `pixels_narrow` and `pixels_wide` say which, and which invocation takes which pixels.

@group(0) @binding(0) var<uniform> view: View;
// [tiles] (first intersection, past the last) in the sorted list, then, in the narrow form, [tiles] (tile, 0) in the order of `order_tiles`; [intersections] slot of each sorted intersection; [intersections] Gaussian of each slot, or, in the wide form, of each sorted intersection.
@group(0) @binding(1) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> gaussians: array<u32>;
// [N, PROJECTED], see `project_forward`.
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;

// A Gaussian of a tile's list: see `project_forward`, and its place in the list.
struct Listed {
    mean: vec4<f32>,
    shape: vec4<f32>,
    color: vec4<f32>,
    position: u32,
    //# planar
    slope: vec2<f32>,
    //# end
}

// The Gaussian at a place of the sorted list, which is a position in its tile's.
fn listed_at(place: u32, position: u32) -> Listed {
    let gaussian = gaussian_at(place);
    var listed: Listed;
    listed.mean = projected[PROJECTED * gaussian];
    listed.shape = projected[PROJECTED * gaussian + 1u];
    listed.color = projected[PROJECTED * gaussian + 2u];
    listed.position = position;
    //# planar
    listed.slope = projected[PROJECTED * gaussian + 3u].xy;
    //# end
    return listed;
}

// Gaussians in workgroup memory.
var<workgroup> batch_mean: array<vec4<f32>, BATCH>;
var<workgroup> batch_shape: array<vec4<f32>, BATCH>;
var<workgroup> batch_color: array<vec4<f32>, BATCH>;
//# planar
var<workgroup> batch_slope: array<vec2<f32>, BATCH>;
//# end

fn keep_listed(at: u32, listed: Listed) {
    batch_mean[at] = listed.mean;
    batch_shape[at] = listed.shape;
    batch_color[at] = listed.color;
    //# planar
    batch_slope[at] = listed.slope;
    //# end
}

// The one at a place of the batch.
fn kept_listed(at: u32, position: u32) -> Listed {
    var listed: Listed;
    listed.mean = batch_mean[at];
    listed.shape = batch_shape[at];
    listed.color = batch_color[at];
    listed.position = position;
    //# planar
    listed.slope = batch_slope[at];
    //# end
    return listed;
}
