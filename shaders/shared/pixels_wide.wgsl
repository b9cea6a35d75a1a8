// The wide form: a tile is divided into sub-tiles of 8×4 pixels, as many as a wide SIMD unit has lanes, and a Gaussian passes by the pixels of those that it
// reaches. About half of all pairs of Gaussian and sub-tile drop out.

alias Pixels = f32;
alias Counts = u32;
alias Flags = bool;

fn sum_of(pixels: Pixels) -> f32 {
    return pixels;
}

fn sum_of_products(a: Pixels, b: Pixels) -> f32 {
    return a * b;
}

fn largest_of(pixels: Pixels) -> f32 {
    return pixels;
}

const SUBTILE_PIXELS: u32 = SUBTILE_WIDTH * SUBTILE_HEIGHT;
const SUBTILES_ACROSS: u32 = TILE_WIDTH / SUBTILE_WIDTH;
const SUBTILES: u32 = SUBTILES_ACROSS * (TILE_HEIGHT / SUBTILE_HEIGHT);
// What the rounding of a squared distance may add.
const REACH_SLACK: f32 = 0.001;

// Behind the rendered image, [buckets, CHECKPOINT, tile's pixels / 4]: where a bucket of BUCKET Gaussians begins within a tile's list, what each pixel has
// blended before it: red, green, blue, depth, transmittance, and of a planar surface both slopes and z². Its number is its first place in the sorted list over
// BUCKET. The vector of which a pixel is a lane:
fn checkpoint_of(bucket: u32, plane: u32, pixel: u32) -> u32 {
    return IMAGE_PLANES * view.width * view.height + ((bucket * CHECKPOINT + plane) * SUBTILES * SUBTILE_PIXELS + pixel) / 4u;
}

fn corner_of(tile: u32) -> vec2<u32> {
    return vec2(tile % view.tiles_x * TILE_WIDTH, tile / view.tiles_x * TILE_HEIGHT);
}

// Of a sub-tile of the tile at `corner`.
fn pixel_of(corner: vec2<u32>, subtile: u32, lane: u32) -> vec2<u32> {
    let x = subtile % SUBTILES_ACROSS * SUBTILE_WIDTH + lane % SUBTILE_WIDTH;
    let y = subtile / SUBTILES_ACROSS * SUBTILE_HEIGHT + lane / SUBTILE_WIDTH;
    return corner + vec2(x, y);
}

fn is_on_image(pixel: vec2<u32>) -> bool {
    return pixel.x < view.width && pixel.y < view.height;
}

// Across and down from the first sub-tile.
const ACROSS: f32 = f32(SUBTILE_WIDTH);
const DOWN: f32 = f32(SUBTILE_HEIGHT);

// A bit for each sub-tile that the Gaussian reaches.
fn subtiles_of(corner: vec2<u32>, gaussian: Listed) -> u32 {
    var reached = 0u;
    for (var s = 0u; s < SUBTILES; s++) {
        let least = vec2<f32>(pixel_of(corner, s, 0u)) - gaussian.mean.xy;
        reached |= select(0u, 1u << s, reaches(least, gaussian));
    }
    return reached;
}

// Whether the ellipse touches the sub-tile whose first pixel lies `least` from the mean: the squared distance, convex, is least at the mean or on an edge that
// faces it. NaN stays in: pixels refuse it.
fn reaches(least: vec2<f32>, gaussian: Listed) -> bool {
    let shape = gaussian.shape;
    let most = least + vec2(f32(SUBTILE_WIDTH - 1u), f32(SUBTILE_HEIGHT - 1u));
    let nearest = clamp(vec2(0.0), least, most);
    let x = clamp(-shape.y * nearest.y / shape.x, least.x, most.x);
    let y = clamp(-shape.x * shape.y * nearest.x / (shape.y * shape.y + shape.z * shape.z), least.y, most.y);
    let closest = min(squared_distance(shape, vec2(x, nearest.y)), squared_distance(shape, vec2(nearest.x, y)));
    return !(closest > gaussian.mean.w + REACH_SLACK * (1.0 + gaussian.mean.w));
}

fn squared_distance(shape: vec4<f32>, offset: vec2<f32>) -> f32 {
    let u = shape.x * offset.x + shape.y * offset.y;
    let v = shape.z * offset.y;
    return u * u + v * v;
}

fn gaussian_at(place: u32) -> u32 {
    return gaussians[place];
}

// The one that an invocation loads of the batch that begins at a place of the list, if there is one. It is asked for a batch ahead, so that nothing waits for it.
fn batch_ahead(first: u32, position: u32, count: u32, lane: u32) -> Listed {
    var listed: Listed;
    if lane < BATCH && position + lane < count {
        listed = listed_at(first + position + lane, position + lane);
    }
    return listed;
}
