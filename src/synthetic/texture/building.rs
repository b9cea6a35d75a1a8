//! Walls, floor and ceiling, and hard materials: wood, metal, stone, glaze, leaves.

use glam::{Vec2, Vec3};

use super::super::noise::{hash, octaves, ramp, spots, unit, value};
use super::{Place, border, line};

/// Charts of the room's shell (lower and upper face), as `shapes` numbers a box's faces.
pub const FLOOR: usize = 4;
pub const CEILING: usize = 5;

pub fn room(place: &Place, seed: u32) -> Vec3 {
    match place.chart {
        FLOOR => planks(place.uv, seed),
        CEILING => ceiling(place.uv, seed),
        chart => {
            // Two neighbouring walls are papered, one is brick, one panelled and plastered; which is which comes from the seed.
            let kind = [0, 2, 1, 3][chart] + hash(1, 2, seed) as usize % 4;
            let wall = match kind % 4 {
                0 => brick(place.uv, seed ^ 0x71),
                1 | 3 => wallpaper(place.uv, seed ^ (chart as u32 * 977)),
                _ => plaster(place, seed ^ 0x9F),
            };
            skirting(place, wall, seed)
        }
    }
}

/// Floorboards 14 cm wide, of random length, colour and grain.
pub fn planks(p: Vec2, seed: u32) -> Vec3 {
    const WIDTH: f32 = 0.14;
    const LENGTH: f32 = 1.3;
    let row = (p.y / WIDTH).floor();
    let shifted = p.x + LENGTH * unit(row as i32, 0, seed ^ 0x5A);
    let board = (shifted / LENGTH).floor();
    let id = hash(row as i32, board as i32, seed);
    let shade = 0.78 + 0.34 * unit(row as i32, board as i32, seed ^ 0xB0);
    let tone = Vec3::new(0.66, 0.47, 0.31).lerp(Vec3::new(0.58, 0.44, 0.33), unit(id as i32, 1, seed)) * shade;
    let wood = grain(Vec2::new(shifted, p.y), tone, id);
    let across = (p.y - row * WIDTH).min((row + 1.0) * WIDTH - p.y);
    let along = (shifted - board * LENGTH).min((board + 1.0) * LENGTH - shifted);
    wood * (1.0 - 0.65 * line(across, 0.0022).max(line(along, 0.002)))
}

/// Wood of basic colour `tone`, its fibres along x: rings cut lengthwise, pores, and a knot here and there.
fn grain(p: Vec2, tone: Vec3, seed: u32) -> Vec3 {
    let drift = octaves(Vec2::new(p.x * 1.6, p.y * 5.0), 3, seed);
    let (knot, tag) = spots(Vec2::new(p.x * 1.7, p.y * 5.5), 0.16, seed ^ 0x44);
    let ring = (p.y * 95.0 + drift * 16.0 + knot * 3.0).sin() * 0.5 + 0.5;
    let fibre = octaves(Vec2::new(p.x * 22.0, p.y * 420.0), 2, seed ^ 0x15);
    let pore = ramp(0.72, 0.86, value(Vec2::new(p.x * 60.0, p.y * 700.0), seed ^ 0x2B));
    let dark = 0.20 * ring * ring + 0.16 * fibre + 0.22 * pore + knot * (0.25 + 0.2 * tag);
    tone * (1.14 - dark) + Vec3::new(0.03, 0.0, -0.02) * (drift - 0.5)
}

pub fn wood(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    // Fibres run along the longer side.
    let p = if place.size.x >= place.size.y { place.uv } else { Vec2::new(place.uv.y, place.uv.x) };
    let id = seed ^ (place.chart as u32 * 131);
    let offset = Vec2::new(unit(1, 1, id), unit(2, 1, id)) * 9.0;
    let edge = 1.0 - 0.22 * (1.0 - ramp(0.0, 0.006, border(place.uv, place.size)));
    grain(p + offset, tint, id) * edge
}

/// Running-bond bricks, 22 x 7 cm with 9 mm of mortar.
fn brick(p: Vec2, seed: u32) -> Vec3 {
    let row = (p.y / 0.079).floor();
    let x = p.x + 0.115 * (row as i32 % 2) as f32;
    let column = (x / 0.229).floor();
    let inside = Vec2::new(x - column * 0.229, p.y - row * 0.079);
    let (i, j) = (column as i32, row as i32);
    let wobble = 0.004 * (octaves(p * 60.0, 2, seed) - 0.5);
    let edge = border(inside, Vec2::new(0.229, 0.079)) + wobble;
    let body = ramp(0.0035, 0.006, edge);
    let warm = Vec3::new(0.64, 0.36, 0.27).lerp(Vec3::new(0.78, 0.55, 0.42), unit(i, j, seed));
    let warm = warm.lerp(Vec3::new(0.42, 0.27, 0.25), ramp(0.82, 0.9, unit(i, j, seed ^ 0x77)));
    let rough = octaves(p * 90.0, 3, seed ^ 0x19);
    let (pit, _) = spots(p * 55.0, 0.28, seed ^ 0x8C);
    let face = warm * (0.78 + 0.42 * rough) * (1.0 - 0.35 * pit);
    let mortar = Vec3::new(0.74, 0.71, 0.66) * (0.8 + 0.3 * octaves(p * 160.0, 2, seed ^ 0x23));
    mortar.lerp(face, body)
}

/// Paper with stripes and scattered sprigs, each of its own shape, so that no two stretches of wall look the same.
fn wallpaper(p: Vec2, seed: u32) -> Vec3 {
    let dark = unit(5, 5, seed) > 0.5;
    let ground = if dark { Vec3::new(0.43, 0.55, 0.57) } else { Vec3::new(0.84, 0.79, 0.68) };
    let ink = if dark { Vec3::new(0.88, 0.85, 0.74) } else { Vec3::new(0.46, 0.42, 0.52) };
    let stripe = 0.05 * ((p.x / 0.24).fract() - 0.5).signum();
    let fine = 0.03 * line((p.x / 0.12).fract() * 0.12 - 0.06, 0.0018);
    let linen = 0.05
        * (octaves(Vec2::new(p.x * 40.0, p.y * 260.0), 2, seed) + octaves(Vec2::new(p.x * 260.0, p.y * 40.0), 2, seed ^ 3) - 1.0);
    let paper = ground * (1.0 + stripe + fine + linen);
    let cell = Vec2::new(0.24, 0.21);
    let row = (p.y / cell.y).floor();
    let shifted = Vec2::new(p.x + 0.12 * (row as i32 % 2) as f32, p.y);
    let column = (shifted.x / cell.x).floor();
    let local = shifted - Vec2::new(column + 0.5, row + 0.5) * cell;
    paper
        .lerp(ink, 0.85 * sprig(local, hash(column as i32, row as i32, seed)))
        .lerp(Vec3::new(0.74, 0.38, 0.32), 0.8 * blossom(local, hash(row as i32, column as i32, seed ^ 0x55)))
}

/// A stem with leaves about the origin, some 8 cm tall.
fn sprig(p: Vec2, id: u32) -> f32 {
    let pick = |k| unit(k, 9, id);
    let lean = (pick(0) - 0.5) * 1.1;
    let p = Vec2::new(p.x * lean.cos() - p.y * lean.sin(), p.x * lean.sin() + p.y * lean.cos());
    let bend = p.x - (pick(1) - 0.5) * 6.0 * (p.y + 0.045) * (p.y + 0.045);
    let mut cover = if p.y.abs() < 0.045 { line(bend, 0.002) } else { 0.0 };
    for k in 0..5 {
        let y = -0.035 + 0.016 * k as f32;
        let side = if (k + (id as i32 & 1)) % 2 == 0 { 1.0 } else { -1.0 };
        let reach = 0.012 + 0.012 * pick(10 + k);
        let q = Vec2::new(p.x - side * reach, p.y - y - 0.4 * (p.x * side)) / Vec2::new(reach, 0.0055 + 0.003 * pick(20 + k));
        cover = cover.max(1.0 - ramp(0.8, 1.0, q.length()));
    }
    cover
}

/// A flower of 4 to 7 petals beside the stem's tip.
fn blossom(p: Vec2, id: u32) -> f32 {
    let centre = Vec2::new(unit(0, 1, id) - 0.5, 0.8) * Vec2::new(0.06, 0.06);
    let q = p - centre;
    let petals = 4.0 + (id % 4) as f32;
    let radius = 0.010 + 0.008 * unit(2, 1, id);
    let outline = radius * (0.72 + 0.28 * (q.y.atan2(q.x) * petals).cos());
    let d = q.length();
    (1.0 - ramp(outline * 0.85, outline, d)) * ramp(radius * 0.18, radius * 0.26, d)
}

/// Painted plaster above boards that reach to 1 m.
fn plaster(place: &Place, seed: u32) -> Vec3 {
    let p = place.uv;
    if p.y < 1.0 {
        let board = (p.x / 0.16).floor();
        let tone = Vec3::new(0.56, 0.63, 0.55) * (0.92 + 0.16 * unit(board as i32, 0, seed));
        let groove = line(p.x - board * 0.16, 0.003).max(line((board + 1.0) * 0.16 - p.x, 0.003)).max(line(p.y - 0.985, 0.003));
        let brush = octaves(Vec2::new(p.x * 240.0, p.y * 14.0), 3, seed ^ 0x0B);
        let (chip, _) = spots(p * 7.0, 0.10, seed ^ 0xCC);
        return tone * (0.86 + 0.26 * brush) * (1.0 - 0.5 * groove) + Vec3::splat(0.25) * chip;
    }
    let cloud = octaves(p * 2.2, 4, seed);
    let trowel = octaves(Vec2::new(p.x * 18.0 + cloud * 5.0, p.y * 30.0), 4, seed ^ 0x31);
    let (fleck, tag) = spots(p * 26.0, 0.30, seed ^ 0x62);
    let base = Vec3::new(0.87, 0.77, 0.62).lerp(Vec3::new(0.80, 0.66, 0.52), cloud);
    base * (0.83 + 0.30 * trowel) * (1.0 - fleck * (0.10 + 0.22 * tag))
}

/// A skirting board along the floor and a rail under the ceiling.
fn skirting(place: &Place, wall: Vec3, seed: u32) -> Vec3 {
    let (p, top) = (place.uv, place.size.y);
    if p.y > 0.09 && p.y < top - 0.05 {
        return wall;
    }
    let board = grain(p, Vec3::new(0.80, 0.76, 0.70), seed ^ 0x99);
    let groove = line(p.y - 0.09, 0.004).max(line(p.y - 0.07, 0.002)).max(line(p.y - top + 0.05, 0.004));
    board * (1.0 - 0.5 * groove)
}

/// Square acoustic tiles with random pin holes.
pub fn ceiling(p: Vec2, seed: u32) -> Vec3 {
    let cell = (p / 0.6).floor();
    let shade = 0.84 + 0.06 * unit(cell.x as i32, cell.y as i32, seed);
    let (hole, tag) = spots(p * 45.0, 0.24, seed ^ 0x41);
    let (worm, _) = spots(p * Vec2::new(14.0, 22.0), 0.22, seed ^ 0x42);
    let seam = line(border(p - cell * 0.6, Vec2::splat(0.6)), 0.004);
    let rough = 0.94 + 0.1 * octaves(p * 120.0, 2, seed);
    Vec3::new(1.0, 0.99, 0.96) * shade * rough * (1.0 - 0.3 * hole * tag - 0.15 * worm) * (1.0 - 0.45 * seam)
}

pub fn metal(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    let brushed = octaves(Vec2::new(place.uv.x * 15.0, place.uv.y * 500.0), 3, seed);
    let (scratch, _) = spots(Vec2::new(place.uv.x * 20.0, place.uv.y * 160.0), 0.2, seed ^ 0x3);
    tint * (0.85 + 0.3 * brushed) * (1.0 - 0.25 * scratch)
}

/// Stone chips of several colours in a ground.
pub fn terrazzo(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    let ground = tint * (0.92 + 0.16 * octaves(place.uv * 150.0, 2, seed));
    let (small, small_tag) = spots(place.uv * 120.0, 0.45, seed ^ 0x61);
    let (large, large_tag) = spots(place.uv * 42.0, 0.48, seed ^ 0x62);
    let chip = |tag: f32| Vec3::splat(0.22 + 0.68 * tag).lerp(super::muted((tag * 4096.0) as u32), 0.45);
    ground.lerp(chip(small_tag), small * 0.8).lerp(chip(large_tag), large)
}

/// Glazed ware: bands and dabs around a pot or cup.
pub fn glazed(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    let p = place.uv;
    let band = (p.y * (40.0 + 30.0 * unit(1, 4, seed))).floor();
    let strong = unit(band as i32, 8, seed);
    let base = tint * (0.75 + 0.45 * strong) * (0.94 + 0.12 * octaves(p * 70.0, 3, seed));
    let (dab, tag) = spots(p * 60.0, 0.42, seed ^ 0x5E);
    base.lerp(Vec3::new(0.92, 0.88, 0.78), dab * f32::from(strong > 0.55) * (0.4 + 0.6 * tag))
}

pub fn leaf(place: &Place, seed: u32) -> Vec3 {
    let q = place.uv / place.size;
    let hue = Vec3::new(0.25, 0.47, 0.22).lerp(Vec3::new(0.42, 0.58, 0.26), unit(1, 1, seed));
    let vein = line(((q.x * 26.0).fract() - 0.5) + (q.y - 0.5) * 0.8, 0.07) * 0.25;
    hue * (0.7 + 0.5 * octaves(place.uv * 60.0, 3, seed)) + Vec3::new(0.25, 0.3, 0.12) * vein
}

pub fn soil(place: &Place, seed: u32) -> Vec3 {
    let (stone, tag) = spots(place.uv * 90.0, 0.4, seed);
    let earth = Vec3::new(0.30, 0.22, 0.17) * (0.6 + 0.8 * octaves(place.uv * 140.0, 3, seed ^ 1));
    earth.lerp(Vec3::splat(0.35 + 0.3 * tag), stone * 0.6)
}

/// A luminaire's diffuser in its frame.
pub fn light_panel(place: &Place) -> Vec3 {
    let edge = border(place.uv, place.size);
    let grid = ((place.uv / 0.05).fract() - 0.5).abs().max_element();
    let lit = Vec3::new(0.95, 0.93, 0.87) * (1.0 - 0.12 * ramp(0.42, 0.47, grid));
    Vec3::splat(0.35).lerp(lit, ramp(0.012, 0.016, edge))
}
