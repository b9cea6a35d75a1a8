// Real spherical harmonics in the order and signs of the 3DGS file format; host twin: `reference::spherical_harmonics`.

// Value of basis function k in the unit direction d.
fn sh_basis(k: u32, d: vec3<f32>) -> f32 {
    let q = d * d;
    switch k {
        case 0u: { return 0.28209479; }
        case 1u: { return -0.48860251 * d.y; }
        case 2u: { return 0.48860251 * d.z; }
        case 3u: { return -0.48860251 * d.x; }
        case 4u: { return 1.0925484 * d.x * d.y; }
        case 5u: { return -1.0925484 * d.y * d.z; }
        case 6u: { return 0.31539157 * (2.0 * q.z - q.x - q.y); }
        case 7u: { return -1.0925484 * d.x * d.z; }
        case 8u: { return 0.54627421 * (q.x - q.y); }
        case 9u: { return -0.59004359 * d.y * (3.0 * q.x - q.y); }
        case 10u: { return 2.8906114 * d.x * d.y * d.z; }
        case 11u: { return -0.45704579 * d.y * (4.0 * q.z - q.x - q.y); }
        case 12u: { return 0.37317633 * d.z * (2.0 * q.z - 3.0 * q.x - 3.0 * q.y); }
        case 13u: { return -0.45704579 * d.x * (4.0 * q.z - q.x - q.y); }
        case 14u: { return 1.4453057 * d.z * (q.x - q.y); }
        default: { return -0.59004359 * d.x * (q.x - 3.0 * q.y); }
    }
}

// Gradient of basis function k with respect to d (as if d were free, not of unit length).
fn sh_basis_gradient(k: u32, d: vec3<f32>) -> vec3<f32> {
    let q = d * d;
    switch k {
        case 0u: { return vec3(0.0); }
        case 1u: { return vec3(0.0, -0.48860251, 0.0); }
        case 2u: { return vec3(0.0, 0.0, 0.48860251); }
        case 3u: { return vec3(-0.48860251, 0.0, 0.0); }
        case 4u: { return 1.0925484 * vec3(d.y, d.x, 0.0); }
        case 5u: { return -1.0925484 * vec3(0.0, d.z, d.y); }
        case 6u: { return 0.31539157 * vec3(-2.0 * d.x, -2.0 * d.y, 4.0 * d.z); }
        case 7u: { return -1.0925484 * vec3(d.z, 0.0, d.x); }
        case 8u: { return 0.54627421 * vec3(2.0 * d.x, -2.0 * d.y, 0.0); }
        case 9u: { return -0.59004359 * vec3(6.0 * d.x * d.y, 3.0 * q.x - 3.0 * q.y, 0.0); }
        case 10u: { return 2.8906114 * vec3(d.y * d.z, d.x * d.z, d.x * d.y); }
        case 11u: { return -0.45704579 * vec3(-2.0 * d.x * d.y, 4.0 * q.z - q.x - 3.0 * q.y, 8.0 * d.y * d.z); }
        case 12u: { return 0.37317633 * vec3(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * q.z - 3.0 * q.x - 3.0 * q.y); }
        case 13u: { return -0.45704579 * vec3(4.0 * q.z - 3.0 * q.x - q.y, -2.0 * d.x * d.y, 8.0 * d.x * d.z); }
        case 14u: { return 1.4453057 * vec3(2.0 * d.x * d.z, -2.0 * d.y * d.z, q.x - q.y); }
        default: { return -0.59004359 * vec3(3.0 * q.x - 3.0 * q.y, -6.0 * d.x * d.y, 0.0); }
    }
}
