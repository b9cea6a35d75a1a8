// Which tiles a step leaves out; host twin: `render::workspace::SKIPPED_TILES`.
struct SkippedTiles {
    // One bit a tile; tiles beyond are never left out.
    bits: array<vec4<u32>, 1024>,
}

fn is_bit_set(bits: vec4<u32>, tile: u32) -> bool {
    return tile < 131072u && (bits[tile / 32u % 4u] >> (tile % 32u) & 1u) == 1u;
}
