// Copies the Gaussians that stay, and the parents of those that come, from one set of planes to another.
struct GatherSetup {
    // Gaussians that stay, and those that come in pairs behind them.
    kept: u32,
    children: u32,
    removed: u32,
    capacity_in: u32,
    capacity_out: u32,
}

@group(0) @binding(0) var<uniform> setup: GatherSetup;
// Those that go, ascending; then for each pair of children their parent, with DIVIDED_BY_CLONING for twins.
@group(0) @binding(1) var<storage, read> changes: array<u32>;
// [planes, capacity] each.
@group(0) @binding(2) var<storage, read> planes_in: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> planes_out: array<vec4<f32>>;

// The place before the change of the Gaussian at place `i` among those that stay: it is that many plus those removed before it.
fn place_before(i: u32) -> u32 {
    var low = 0u;
    var high = setup.removed;
    while low < high {
        let middle = (low + high) / 2u;
        if changes[middle] - middle <= i {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return i + low;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i >= setup.kept + setup.children {
        return;
    }
    var from_ = 0u;
    if i < setup.kept {
        from_ = place_before(i);
    } else {
        from_ = changes[setup.removed + (i - setup.kept) / 2u] & ~DIVIDED_BY_CLONING;
    }
    let planes = arrayLength(&planes_in) / setup.capacity_in;
    for (var plane = 0u; plane < planes; plane++) {
        planes_out[plane * setup.capacity_out + i] = planes_in[plane * setup.capacity_in + from_];
    }
}
