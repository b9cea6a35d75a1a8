// Which tiles a step samples; host twin: `render::workspace::UNSAMPLED_MASK_BYTES`.
struct UnsampledTiles {
    // One bit a tile, set if it is not sampled; tiles beyond are always sampled.
    bits: array<vec4<u32>, 1024>,
}

fn is_bit_set(bits: vec4<u32>, tile: u32) -> bool {
    return tile < 131072u && ((bits[(tile / 32u) % 4u] >> (tile % 32u)) & 1u) == 1u;
}
