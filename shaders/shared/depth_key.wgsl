// 16 bits of a depth between NEAR_METRES and FAR_METRES: the bits of positive floats grow with them. Depths closer together than 1 in 3,000
// keep the order of the map. Host twin: `splat::model::depth_key`.
fn depth_key(depth: f32) -> u32 {
    return (bitcast<u32>(depth) - bitcast<u32>(NEAR_METRES)) / DEPTH_KEY_STEP;
}
