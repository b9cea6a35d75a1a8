// The narrow form: a workgroup covers GROUP_TILES tiles, each with TILE_THREADS invocations; an invocation takes a block of STRIPS strips of 4×1 pixels below
// one another, a strip held as the lanes of a vec4. Every Gaussian passes by every pixel of its tile.

alias Pixels = vec4<f32>;
alias Counts = vec4<u32>;
alias Flags = vec4<bool>;

fn sum_of(pixels: Pixels) -> f32 {
    return dot(pixels, vec4(1.0));
}

fn sum_of_products(a: Pixels, b: Pixels) -> f32 {
    return dot(a, b);
}

fn largest_of(pixels: Pixels) -> f32 {
    return max(max(pixels.x, pixels.y), max(pixels.z, pixels.w));
}

const BLOCKS_ACROSS: u32 = TILE_WIDTH / 4u;
const TILE_THREADS: u32 = BLOCKS_ACROSS * TILE_HEIGHT / STRIPS;
const THREADS: u32 = TILE_THREADS * GROUP_TILES;
// Gaussians of each tile held in workgroup memory at a time, and of all tiles.
const TILE_BATCH: u32 = 64u;
const BATCH: u32 = TILE_BATCH * GROUP_TILES;

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
    // Successive workgroups go to one thread of a software adapter: each stretch of them takes from the whole list, whose end has nothing to do.
    let part = (tiles + GROUP_TILES * LIST_PARTS - 1u) / (GROUP_TILES * LIST_PARTS);
    let turn = (group % LIST_PARTS * part + group / LIST_PARTS) * GROUP_TILES + member;
    let is_there = turn < tiles && group / LIST_PARTS < part;
    let tile = select(tiles, ranges[tiles + min(turn, tiles - 1u)].x, is_there);
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

// The members' tiles load up to TILE_BATCH of their Gaussians each, from the intersection `start` of each one's list on, up to the intersection `end`.
fn load_batch(place: Place, start: u32, end: u32) {
    for (var k = place.thread; start + k < min(end, start + TILE_BATCH); k += TILE_THREADS) {
        keep_listed(place.member * TILE_BATCH + k, listed_at(place.range.x + start + k, start + k));
    }
}

fn gaussian_at(place: u32) -> u32 {
    return gaussians[sorted_slots[place]];
}
