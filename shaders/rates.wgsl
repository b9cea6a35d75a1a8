// What the adapter can do at best: copying through memory, and multiply-adds in registers. Measured beside the stages, so that
// their floors belong to the same machine in the same minute.

@group(0) @binding(0) var<storage, read> source: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> sink: array<vec4<f32>>;

// Multiply-adds of one invocation: 4 lanes × 8 chains × ROUNDS.
const ROUNDS: u32 = 256u;

@compute @workgroup_size(256)
fn copy_memory(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    if i < arrayLength(&source) {
        sink[i] = source[i];
    }
}

@compute @workgroup_size(256)
fn multiply_add(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = linear_workgroup(workgroup) * 256u + local;
    let factor = source[0];
    let addend = source[1];
    // Eight independent chains hide the latency of each.
    var a = vec4(f32(i));
    var b = a + 1.0;
    var c = a + 2.0;
    var d = a + 3.0;
    var e = a + 4.0;
    var f = a + 5.0;
    var g = a + 6.0;
    var h = a + 7.0;
    for (var k = 0u; k < ROUNDS; k++) {
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
        e = fma(e, factor, addend);
        f = fma(f, factor, addend);
        g = fma(g, factor, addend);
        h = fma(h, factor, addend);
    }
    sink[i % arrayLength(&sink)] = a + b + c + d + e + f + g + h;
}
