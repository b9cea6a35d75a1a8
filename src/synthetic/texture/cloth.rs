//! Woven things: checked cloth, tweed, rugs, lampshades.

use glam::{Vec2, Vec3};

use super::super::noise::{hash, octaves, ramp, unit, value};
use super::{Place, border, line};

/// Threads over and under, about 2.5 mm apart; a factor around 1.
fn weave(p: Vec2, seed: u32) -> f32 {
    let thread = p / 0.0025;
    let over = ((thread.x.floor() + thread.y.floor()) as i32).rem_euclid(2) == 0;
    let f = thread - thread.floor();
    let round = if over { f.x * (1.0 - f.x) } else { f.y * (1.0 - f.y) };
    0.86 + 0.5 * round + 0.10 * (octaves(p * 90.0, 2, seed) - 0.5)
}

/// Checks of two colours with thin lines through them, and a random tint per square.
pub fn checks(place: &Place, a: Vec3, b: Vec3, seed: u32) -> Vec3 {
    const SIDE: f32 = 0.045;
    let p = place.uv;
    let cell = (p / SIDE).floor();
    let (i, j) = (cell.x as i32, cell.y as i32);
    let mixed = match (i.rem_euclid(2), j.rem_euclid(2)) {
        (0, 0) => a,
        (1, 1) => b,
        _ => (a + b) * 0.5,
    };
    let f = p / SIDE - cell - 0.5;
    let thin = line(f.x, 0.05).max(line(f.y, 0.05)) * 0.35;
    let tinted = mixed * (0.88 + 0.24 * unit(i, j, seed));
    tinted.lerp(Vec3::new(0.85, 0.80, 0.66), thin) * weave(p, seed)
}

/// Woollen cloth: a plain tint, flecked with lighter and darker threads, with seams at the borders.
pub fn tweed(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    let p = place.uv;
    let fleck = |scale: Vec2, salt| ramp(0.66, 0.84, value(p * scale, seed ^ salt));
    let light = fleck(Vec2::new(190.0, 60.0), 1).max(fleck(Vec2::new(50.0, 150.0), 2));
    let dark = fleck(Vec2::new(130.0, 130.0), 3).max(fleck(Vec2::new(60.0, 45.0), 4) * 0.8);
    let fold = 0.9 + 0.2 * octaves(p * 5.0, 4, seed ^ 5);
    let seam = line(border(p, place.size) - 0.012, 0.0025);
    let cloth = tint * fold * weave(p, seed) + Vec3::splat(0.20) * light;
    cloth * (1.0 - 0.42 * dark) * (1.0 - 0.5 * seam)
}

/// A knotted rug: borders, a field of hooked diamonds that all differ, a fringe at both ends.
pub fn rug(place: &Place, a: Vec3, b: Vec3, seed: u32) -> Vec3 {
    let knot = 0.006;
    let p = ((place.uv / knot).floor() + 0.5) * knot;
    let edge = border(p, place.size);
    let cream = Vec3::new(0.86, 0.78, 0.62);
    let dark = Vec3::new(0.20, 0.19, 0.26);
    let seen = if edge < 0.03 {
        let on = unit((p.x / 0.012) as i32 + (p.y / 0.012) as i32 * 7, 3, seed) > 0.45;
        if on { cream } else { dark }
    } else if edge < 0.17 {
        band(p, place.size, edge, [a, b, cream, dark], seed)
    } else {
        field(p - place.size * 0.5, [a, b, cream, dark], seed)
    };
    let wear = 0.78 + 0.34 * octaves(place.uv * 9.0, 4, seed ^ 0x4);
    let pile = 0.86 + 0.28 * octaves(place.uv * 210.0, 2, seed ^ 0x8);
    seen * wear * pile
}

/// The border: stars and steps in cells along the edge.
fn band(p: Vec2, size: Vec2, edge: f32, [a, b, cream, dark]: [Vec3; 4], seed: u32) -> Vec3 {
    if (edge - 0.036).abs() < 0.006 || (edge - 0.164).abs() < 0.006 {
        return dark;
    }
    let along = if p.x.min(size.x - p.x) < p.y.min(size.y - p.y) { p.y } else { p.x };
    let cell = (along / 0.12).floor();
    let q = Vec2::new(along - (cell + 0.5) * 0.12, edge - 0.10);
    let id = hash(cell as i32, (p.x < size.x * 0.5) as i32 * 2 + (p.y < size.y * 0.5) as i32, seed ^ 0x77);
    let diamond = q.x.abs() + q.y.abs() * (0.8 + 0.5 * unit(1, 1, id));
    let cross = q.x.abs().min(q.y.abs());
    if diamond < 0.016 {
        cream
    } else if diamond < 0.042 && (id & 1 == 0 || cross < 0.008) {
        b
    } else if diamond < 0.052 {
        dark
    } else {
        a * 0.85
    }
}

/// The field about its centre: a large medallion over a lattice of small diamonds.
fn field(q: Vec2, [a, b, cream, dark]: [Vec3; 4], seed: u32) -> Vec3 {
    let medallion = q.x.abs() * 0.8 + q.y.abs() * 1.1 + 0.02 * ((q.x.abs() / 0.04).floor() % 2.0);
    let (ground, figure) = if medallion < 0.16 {
        (cream, a)
    } else if medallion < 0.19 {
        return dark;
    } else if medallion < 0.42 {
        (b, cream)
    } else if medallion < 0.44 {
        return cream;
    } else {
        (a, b)
    };
    let cell = (q / 0.11).floor();
    let r = (q / 0.11 - cell - 0.5) * 0.11;
    let id = hash(cell.x as i32, cell.y as i32, seed ^ 0x31);
    let shape = match id % 4 {
        0 => r.x.abs() + r.y.abs(),
        1 => r.x.abs().max(r.y.abs()) * 1.3,
        2 => (r.x.abs() + r.y.abs() * 0.4).max(r.y.abs()),
        _ => (r.x.abs() * 0.5 + r.y.abs()).max(r.x.abs() * 0.9),
    };
    let rings = 0.016 + 0.012 * unit(4, 4, id);
    if shape < rings * 0.55 {
        dark
    } else if shape < rings {
        figure
    } else if shape < rings + 0.008 {
        dark.lerp(ground, 0.4)
    } else if shape < rings + 0.016 && id & 8 != 0 {
        cream
    } else {
        ground
    }
}

pub fn lampshade(place: &Place, seed: u32) -> Vec3 {
    let rib = ((place.uv.x / 0.035).fract() - 0.5).abs();
    let glow = 1.0 - 0.25 * ((place.uv.y / place.size.y) - 0.4).abs();
    let edge = ramp(0.008, 0.012, place.uv.y.min(place.size.y - place.uv.y));
    let shade = Vec3::new(0.98, 0.88, 0.68) * glow * (0.85 + 0.15 * ramp(0.0, 0.08, rib)) * weave(place.uv, seed).min(1.0);
    Vec3::new(0.55, 0.38, 0.24).lerp(shade, edge)
}
