// Blends a tile's Gaussians front to back into colour, depth and transmittance (Kerbl et al. 2023, eq. 3).

// [H, W] (r, g, b, Σ w z): colour over the background, depth weighted by what was blended. Of a planar surface, depth is that of each Gaussian's plane at the
// pixel, and [H, W] (Σ w slope x, Σ w slope y, Σ w z², median depth) follows. Behind it, in the wide form, are checkpoints for the backward pass.
@group(0) @binding(5) var<storage, read_write> color_depth: array<vec4<f32>>;
// [H, W] (bits of the transmittance, intersections of the tile's list up to and with the last one blended).
@group(0) @binding(6) var<storage, read_write> state: array<vec2<u32>>;

// What pixels have blended so far.
struct Blended {
    red: Pixels,
    green: Pixels,
    blue: Pixels,
    depth: Pixels,
    //# planar
    slope_x: Pixels,
    slope_y: Pixels,
    squared_depth: Pixels,
    // Depth of the Gaussian behind which less than half of the light is left.
    median_depth: Pixels,
    //# end
    transmittance: Pixels,
    last: Counts,
    // Whether the pixel takes more.
    open: Flags,
}

// Blends one Gaussian into pixels that lie (dx, dy) from its mean; alpha is opacity·exp(-½dᵀΣ⁻¹d), down to the cut. Nothing is left out by branches: the narrow
// form's adapters would run both sides.
fn blend(gaussian: Listed, dx: Pixels, dy: f32, to: ptr<function, Blended>) {
    let shape = gaussian.shape;
    let u = shape.x * dx + shape.y * dy;
    let v = shape.z * dy;
    let distance = u * u + v * v;
    let hit = (*to).open & (distance <= Pixels(gaussian.mean.w));
    let alpha = min(Pixels(ALPHA_MAX), shape.w * exp(-distance));
    let next = (*to).transmittance * (1.0 - alpha);
    let stop = hit & (next < Pixels(TRANSMITTANCE_MIN));
    let taken = hit & !stop;
    (*to).open = (*to).open & !stop;
    let weight = select(Pixels(0.0), alpha * (*to).transmittance, taken);
    var depth = Pixels(gaussian.mean.z);
    //# planar
    depth += gaussian.slope.x * dx + gaussian.slope.y * dy;
    (*to).slope_x += weight * gaussian.slope.x;
    (*to).slope_y += weight * gaussian.slope.y;
    (*to).squared_depth += weight * depth * depth;
    (*to).median_depth = select((*to).median_depth, depth, (weight > Pixels(0.0)) & ((*to).transmittance > Pixels(0.5)));
    //# end
    (*to).red += weight * gaussian.color.x;
    (*to).green += weight * gaussian.color.y;
    (*to).blue += weight * gaussian.color.z;
    (*to).depth += weight * depth;
    (*to).transmittance = select((*to).transmittance, next, taken);
    (*to).last = select((*to).last, Counts(gaussian.position + 1u), taken);
}
