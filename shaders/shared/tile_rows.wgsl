// The tiles that each visible Gaussian really touches, for `tile_lists_*`: once to count, once to emit.
//
// A tile is touched where the ellipse of alpha ≥ 1/255 reaches the hull of its pixel centres. In a row of tiles the ellipse spans an interval,
// which has a closed form. The same pipeline counts and emits, so that both agree.

struct TileListsSetup {
    // 0 counts, 1 emits.
    emit: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> setup: TileListsSetup;
@group(0) @binding(2) var<storage, read> counters: array<Counter>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;
// [visible] tiles of each Gaussian, in `order` (mode 0); behind them, from `capacity` on, its first slot and that past its last, in map
// order (mode 1); and from three times that on, which Gaussians are visible, in map order (`compact_visible`).
@group(0) @binding(5) var<storage, read_write> intersection_counts: array<u32>;
// [visible / 256] intersections of each workgroup's Gaussians (mode 0), of those before it (mode 1).
@group(0) @binding(6) var<storage, read_write> block_sums: array<u32>;
// [intersections] slots of the tiles' lists, before they are sorted.
@group(0) @binding(8) var<storage, read_write> slots: array<u32>;
// [intersections] Gaussian of each slot.
@group(0) @binding(9) var<storage, read_write> slot_gaussians: array<u32>;

// Slack for rounding, absolute and relative: a tile too many costs time, one too few a seam.
const SLACK: f32 = 1e-3;
const TILE_SIZE = vec2(f32(TILE_WIDTH), f32(TILE_HEIGHT));

// A Gaussian's outline in the image. With d measured from the mean, it is |(u, v)|² = limit, u = xx·dx + xy·dy and v = yy·dy.
struct Outline {
    mean: vec2<f32>,
    conic_factor: vec3<f32>,
    limit: f32,
    // dy of its rightmost point, pixels; the leftmost lies opposite.
    rightmost: f32,
    // First row of tiles that it may touch, and past the last.
    first_row: u32,
    end_row: u32,
}

// Pixel centres are integers, so a tile's pixels span [first, first + size - 1].
fn outline_of(gaussian: u32) -> Outline {
    let mean_cut = projected[PROJECTED * gaussian];
    let factor = projected[PROJECTED * gaussian + 1u].xyz;
    let half_extent = unpack2x16float(bitcast<u32>(projected[PROJECTED * gaussian + 2u].w)).y;
    let limit = mean_cut.w * (1.0 + SLACK) + SLACK;
    let rightmost = -factor.y / factor.z * sqrt(limit) * inverseSqrt(factor.y * factor.y + factor.z * factor.z);
    let bounds = floor(vec2(mean_cut.y - half_extent, mean_cut.y + half_extent) / TILE_SIZE.y);
    let rows = vec2<u32>(clamp(bounds, vec2(0.0), vec2(f32(view.tiles_y) - 1.0)));
    return Outline(mean_cut.xy, factor, limit, rightmost, rows.x, rows.y + 1u);
}

// Neighbouring tiles of one row.
struct TileRow {
    first: u32,
    count: u32,
}

// The tiles of the row `y` that the outline touches. Its right end is concave in dy: within the row it is furthest out at the dy closest to that of the
// rightmost point. So is its left end.
fn row_of(outline: Outline, y: u32) -> TileRow {
    let factor = outline.conic_factor;
    let low = f32(y) * TILE_SIZE.y - outline.mean.y;
    let high = low + TILE_SIZE.y - 1.0;
    let ends = clamp(vec2(-outline.rightmost, outline.rightmost), vec2(low), vec2(high));
    let v = factor.z * ends;
    let half = sqrt(max(vec2(outline.limit) - v * v, vec2(0.0)));
    let x = outline.mean.x + (vec2(-half.x, half.y) - factor.y * ends) / factor.x;
    let last_tile = f32(view.tiles_x) - 1.0;
    let first = clamp(ceil((x.x - TILE_SIZE.x + 1.0) / TILE_SIZE.x), 0.0, last_tile + 1.0);
    let last = clamp(floor(x.y / TILE_SIZE.x), -1.0, last_tile);
    let nearest = factor.z * clamp(0.0, low, high);
    let count = select(0.0, max(last - first + 1.0, 0.0), nearest * nearest <= outline.limit);
    return TileRow(y * view.tiles_x + u32(first), u32(count));
}
