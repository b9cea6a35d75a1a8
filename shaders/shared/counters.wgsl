// Counts made on the GPU and the dispatch sizes that follow from them; host twin: `render::layout::Counter`.
struct Counter {
    // Elements to process; 0 when there was no room for `needed`.
    count: u32,
    // Elements there would be with unlimited room.
    needed: u32,
    // Indirect dispatch (x, y, z) with one invocation an element, 256 a workgroup.
    per_element: array<u32, 3>,
    // Indirect dispatch with one workgroup per SORT_BLOCK elements.
    per_block: array<u32, 3>,
    // Indirect dispatch with one workgroup per bucket of a tile's list, or somewhat more.
    per_bucket: array<u32, 3>,
}

// Of so many elements of so many needed, in an image of so many tiles.
fn counter_of(count: u32, needed: u32, tiles: u32) -> Counter {
    let blocks = dispatch_of((count + SORT_BLOCK - 1u) / SORT_BLOCK);
    return Counter(count, needed, dispatch_of((count + 255u) / 256u), blocks, dispatch_of(tiles + count / BUCKET + 1u));
}

fn dispatch_of(workgroups: u32) -> array<u32, 3> {
    let rows = (workgroups + 65534u) / 65535u;
    return array<u32, 3>(min(workgroups, 65535u), max(rows, 1u), 1u);
}
