//! Hashes and smooth noise for procedural textures: integer hashing, value noise on a lattice, and sums of its octaves.

use glam::{Vec2, Vec3};

/// Mixes a lattice cell and a seed into 32 well-spread bits (a multiply-xorshift finaliser over odd multiples of the inputs).
pub fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77).rotate_left(13);
    h ^= seed.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// A hash as a number in `0..1`.
pub fn unit(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 / 16_777_216.0
}

/// Cubic blend with flat ends.
pub fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// 0 below `low`, 1 above `high`, smooth in between.
pub fn ramp(low: f32, high: f32, x: f32) -> f32 {
    smooth(((x - low) / (high - low)).clamp(0.0, 1.0))
}

/// Value noise in `0..1`, one feature per unit of `p`.
pub fn value(p: Vec2, seed: u32) -> f32 {
    let (x, y, f) = cell(p);
    let (u, v) = (smooth(f.x), smooth(f.y));
    let bottom = unit(x, y, seed) * (1.0 - u) + unit(x + 1, y, seed) * u;
    let top = unit(x, y + 1, seed) * (1.0 - u) + unit(x + 1, y + 1, seed) * u;
    bottom * (1.0 - v) + top * v
}

/// The lattice cell of a point, and its place in it. (Casts, since `floor` is a call on plain x86-64.)
fn cell(p: Vec2) -> (i32, i32, Vec2) {
    let down = |v: f32| v as i32 - i32::from(v < 0.0);
    let (x, y) = (down(p.x), down(p.y));
    (x, y, Vec2::new(p.x - x as f32, p.y - y as f32))
}

/// Sum of `octaves` of value noise, each of twice the frequency and half the height; in `0..1`.
pub fn octaves(p: Vec2, octaves: u32, seed: u32) -> f32 {
    let (mut sum, mut weight, mut total, mut at) = (0.0, 1.0, 0.0, p);
    for octave in 0..octaves {
        sum += weight * value(at, seed.wrapping_add(octave * 101));
        total += weight;
        weight *= 0.5;
        at = Vec2::new(at.x * 1.6 - at.y * 1.2, at.x * 1.2 + at.y * 1.6) + 17.3;
    }
    sum / total
}

/// Scattered spots of differing size and roundness: 1 inside a spot, 0 outside, at most one spot per unit cell.
/// `radius` is the largest, up to 0.6. Returns the coverage and the spot's own random number.
pub fn spots(p: Vec2, radius: f32, seed: u32) -> (f32, f32) {
    let (x, y, f) = cell(p);
    // Centres keep a quarter of a cell from its border, so only the four nearest cells can reach the point.
    let (left, below) = (x - i32::from(f.x < 0.5), y - i32::from(f.y < 0.5));
    let (mut cover, mut tag) = (0.0f32, 0.0);
    for (i, j) in [(left, below), (left + 1, below), (left, below + 1), (left + 1, below + 1)] {
        let h = hash(i, j, seed);
        let part = |shift: u32| ((h >> shift) & 0xFF) as f32 / 255.0;
        let centre = Vec2::new(i as f32 + 0.25 + 0.5 * part(0), j as f32 + 0.25 + 0.5 * part(8));
        let size = radius * (0.35 + 0.65 * part(16));
        let squeeze = 0.8 + 0.45 * part(24);
        let d = (p - centre) * Vec2::new(squeeze, 1.0 / squeeze);
        let square = d.length_squared();
        if square < size * size {
            let here = 1.0 - ramp(size * 0.85, size, square.sqrt());
            if here > cover {
                (cover, tag) = (here, unit(i, j, seed ^ 0xF1));
            }
        }
    }
    (cover, tag)
}

/// A colour from hue (turns), saturation and value, each `0..1`.
pub fn hsv(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |offset: f32| {
        let k = (offset + hue * 6.0).rem_euclid(6.0);
        value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0))
    };
    Vec3::new(channel(5.0), channel(3.0), channel(1.0))
}
