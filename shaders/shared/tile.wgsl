// Tiles' Gaussians and pixels, as the blending passes see them. A workgroup covers GROUP_TILES tiles, each with TILE_THREADS invocations; an
// invocation takes a block of STRIPS strips of 4×1 pixels below one another, a strip held as the lanes of a vec4, and the Gaussians pass in batches
// through workgroup memory.

@group(0) @binding(0) var<uniform> view: View;
// [tiles] (first intersection, past the last) in the sorted list, then, in the narrow form, [tiles] (tile, 0) in the order of `order_tiles`; [intersections] slot of each sorted intersection; [intersections] Gaussian of each slot.
@group(0) @binding(1) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> slot_gaussians: array<u32>;
// [N, PROJECTED], see `project_forward`.
@group(0) @binding(4) var<storage, read> projected: array<vec4<f32>>;

const BLOCKS_ACROSS: u32 = TILE_WIDTH / 4u;
const TILE_THREADS: u32 = BLOCKS_ACROSS * TILE_HEIGHT / STRIPS;
const THREADS: u32 = TILE_THREADS * GROUP_TILES;
// Gaussians of each tile held in workgroup memory at a time.
const BATCH: u32 = 64u;
var<workgroup> batch_mean: array<vec4<f32>, BATCH * GROUP_TILES>;
var<workgroup> batch_conic_factor: array<vec4<f32>, BATCH * GROUP_TILES>;
var<workgroup> batch_color: array<vec4<f32>, BATCH * GROUP_TILES>;
//# planar
var<workgroup> batch_slope: array<vec2<f32>, BATCH * GROUP_TILES>;
//# end

// An invocation's place: its tile, the tile's number in the workgroup, its own in the tile, and the tile's intersections in the sorted list. Beyond the last tile
// there are no intersections and no pixels.
struct Place {
    tile: u32,
    member: u32,
    thread: u32,
    range: vec2<u32>,
    block: Block,
}

struct Block {
    // Columns of all strips, and the first strip's row.
    x: vec4<f32>,
    y: f32,
    // What is on the image: of the columns, and the number of rows.
    columns: vec4<bool>,
    rows: u32,
    // Row-major pixel index of the corner.
    first: u32,
}

fn place_of(group: u32, local: u32) -> Place {
    let member = local / TILE_THREADS;
    let thread = local % TILE_THREADS;
    let tiles = view.tiles_x * view.tiles_y;
    var tile = min(group, tiles);
    if GROUP_TILES > 1u {
        // Successive workgroups go to one thread of a software adapter: each stretch of them takes from the whole list, whose end has nothing to do.
        let part = (tiles + GROUP_TILES * LIST_PARTS - 1u) / (GROUP_TILES * LIST_PARTS);
        let turn = (group % LIST_PARTS * part + group / LIST_PARTS) * GROUP_TILES + member;
        let is_there = turn < tiles && group / LIST_PARTS < part;
        tile = select(tiles, ranges[tiles + min(turn, tiles - 1u)].x, is_there);
    }
    let range = select(vec2(0u), ranges[min(tile, tiles - 1u)], tile < tiles);
    return Place(tile, member, thread, range, block_of(tile, thread));
}

// The blocks follow in rows. Below the image a block has no rows.
fn block_of(tile: u32, thread: u32) -> Block {
    let x = (tile % view.tiles_x) * TILE_WIDTH + thread % BLOCKS_ACROSS * 4u;
    let y = (tile / view.tiles_x) * TILE_HEIGHT + thread / BLOCKS_ACROSS * STRIPS;
    let columns = vec4(x) + vec4(0u, 1u, 2u, 3u);
    let rows = view.height - min(y, view.height);
    return Block(vec4<f32>(columns), f32(y), columns < vec4(view.width), rows, y * view.width + x);
}

// The members' tiles load up to BATCH of their Gaussians each, from the intersection `start` of each one's list on, up to the intersection `end`.
fn load_batch(place: Place, start: u32, end: u32) {
    let to = place.member * BATCH;
    for (var k = place.thread; start + k < min(end, start + BATCH); k += TILE_THREADS) {
        let gaussian = slot_gaussians[sorted_slots[place.range.x + start + k]];
        batch_mean[to + k] = projected[PROJECTED * gaussian];
        batch_conic_factor[to + k] = projected[PROJECTED * gaussian + 1u];
        batch_color[to + k] = projected[PROJECTED * gaussian + 2u];
        //# planar
        batch_slope[to + k] = projected[PROJECTED * gaussian + 3u].xy;
        //# end
    }
}
