//! Printed and painted things: books, posters, paintings, paper, cardboard, screens, and the view from the window.

use glam::{Vec2, Vec3};

use super::super::noise::{hash, hsv, octaves, ramp, spots, unit};
use super::{Place, border, line, muted};

/// Strokes of a made-up script: 1 on ink. `p` is in letter heights; `x` runs along the line, which is 1 high.
fn glyph(p: Vec2, id: u32) -> f32 {
    let q = Vec2::new(p.x / 0.62, p.y);
    if !(0.0..1.0).contains(&q.x) || !(0.0..1.0).contains(&q.y) {
        return 0.0;
    }
    let mut ink = 0.0f32;
    // Verticals, horizontals and diagonals of a 2 x 3 frame, each there or not; at least the first is.
    let bit = |k: u32| k == id % 3 || (id >> (5 + k)) & 1 == 1;
    let strokes = [
        (Vec2::new(0.15, 0.1), Vec2::new(0.15, 0.9)),
        (Vec2::new(0.78, 0.1), Vec2::new(0.78, 0.9)),
        (Vec2::new(0.15, 0.9), Vec2::new(0.78, 0.9)),
        (Vec2::new(0.15, 0.5), Vec2::new(0.78, 0.5)),
        (Vec2::new(0.15, 0.1), Vec2::new(0.78, 0.1)),
        (Vec2::new(0.15, 0.5), Vec2::new(0.78, 0.1)),
        (Vec2::new(0.15, 0.9), Vec2::new(0.78, 0.5)),
    ];
    for (k, (from, to)) in strokes.into_iter().enumerate().filter(|(k, _)| bit(*k as u32)) {
        let along = to - from;
        let t = ((q - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
        let wide = if k % 3 == 0 { 0.09 } else { 0.07 };
        ink = ink.max(1.0 - ramp(wide * 0.8, wide * 1.2, (q - from - along * t).length()));
    }
    ink
}

/// Ink of a block of writing: lines of words in letters of `height` metres, from the top of `size` down.
fn writing(p: Vec2, size: Vec2, height: f32, seed: u32) -> f32 {
    let row = ((size.y - p.y) / (height * 1.6)).floor();
    let y = 1.0 - ((size.y - p.y) / height - row * 1.6);
    let column = (p.x / (height * 0.75)).floor();
    let x = p.x / height - column * 0.75;
    let line_end = size.x * (0.6 + 0.4 * unit(row as i32, 1, seed));
    let blank = unit(column as i32, row as i32, seed ^ 0x1F) < 0.16 || p.x > line_end || unit(row as i32, 2, seed) < 0.12;
    if blank || p.x < 0.0 || p.y < 0.0 || p.y > size.y {
        0.0
    } else {
        glyph(Vec2::new(x, y), hash(column as i32, row as i32, seed))
    }
}

pub fn book(place: &Place, tint: Vec3, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    // Charts 4 and 5 are the cut edges at top and bottom, where one sees pages.
    if place.chart >= 4 {
        let (page, leaf) = if size.x > size.y { (p.y, p.x) } else { (p.x, p.y) };
        return Vec3::new(0.88, 0.84, 0.74) * (0.75 + 0.3 * octaves(Vec2::new(page * 900.0, leaf * 12.0), 2, seed));
    }
    let cloth = tint * (0.86 + 0.22 * octaves(p * 160.0, 3, seed)) * (0.8 + 0.2 * ramp(0.0, 0.004, border(p, size)));
    let gold = if tint.element_sum() > 1.5 { Vec3::new(0.25, 0.2, 0.2) } else { Vec3::new(0.90, 0.80, 0.52) };
    let accent = muted(seed ^ 0xACC);
    let q = p / size;
    let pick = |k| unit(k, 3, seed);
    let lower = 0.12 + 0.1 * pick(1);
    let upper = 0.80 + 0.1 * pick(2);
    let banded = if q.y < lower && pick(3) > 0.4 || q.y > upper && pick(4) > 0.4 { accent } else { cloth };
    let rules = [lower, upper, lower + 0.03, upper - 0.04].iter().map(|y| line(p.y - y * size.y, 0.0015)).fold(0.0, f32::max);
    // The title runs up the spine.
    let title = Vec2::new(size.y * (upper - lower - 0.14), (size.x * 0.55).min(0.05));
    let along = Vec2::new(p.y - size.y * (lower + 0.07), title.y - (p.x - (size.x - title.y) * 0.5));
    let ink = if along.y > 0.0 && along.y < title.y { writing(along, title, title.y * 0.8, seed ^ 0xB00) } else { 0.0 };
    banded.lerp(gold, rules.max(ink) * 0.9)
}

/// A poster: coloured ground, overlapping shapes, a headline and small print, in a thin white margin.
pub fn poster(place: &Place, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    let pick = |k| unit(k, 11, seed);
    if border(p, size) < 0.018 {
        return Vec3::splat(0.88) * (0.95 + 0.08 * octaves(p * 200.0, 2, seed));
    }
    let hue = pick(1);
    let ground = hsv(hue, 0.18 + 0.26 * pick(2), 0.6 + 0.3 * pick(3));
    let mut seen = ground * (0.9 + 0.18 * octaves(p * 14.0, 4, seed));
    for k in 0..9 {
        let salt = seed ^ (k as u32 * 7919);
        let r = |j| unit(j, 13, salt);
        let centre = size * Vec2::new(0.12 + 0.76 * r(1), 0.36 + 0.52 * r(2));
        let extent = size.x * (0.05 + 0.15 * r(3));
        let turn = r(4) * 6.3;
        let q = glam::Mat2::from_angle(turn) * (p - centre);
        let inside = match hash(k, 5, salt) % 4 {
            0 => 1.0 - ramp(extent - 0.001, extent + 0.001, q.length()),
            1 => 1.0 - ramp(-0.001, 0.001, q.abs().max_element() - extent * 0.8),
            2 => 1.0 - ramp(-0.001, 0.001, (q.y - extent * 0.5).max(q.x.abs() - (extent * 0.5 - q.y) * 0.6)),
            _ => line(q.length() - extent, extent * 0.18),
        };
        let stripes = if r(6) > 0.6 { 0.75 + 0.25 * ((q.x / 0.012).sin()).signum() } else { 1.0 };
        let color = hsv(hue + 0.15 + 0.6 * r(5), 0.42, 0.3 + 0.6 * r(7)) * stripes;
        seen = seen.lerp(color, inside * 0.92);
    }
    let headline =
        writing(p - Vec2::new(0.05, size.y * 0.17), Vec2::new(size.x - 0.1, size.y * 0.12), size.x * 0.11, seed ^ 0x4EAD);
    let small = writing(p - Vec2::new(0.05, 0.04), Vec2::new(size.x - 0.1, size.y * 0.11), 0.012, seed ^ 0x5A11);
    seen.lerp(Vec3::splat(if ground.element_sum() > 1.9 { 0.1 } else { 0.93 }), headline.max(small))
}

/// Hills behind hills under a sky, in brush strokes.
pub fn painting(place: &Place, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    if border(p, size) < 0.03 {
        let carved = 0.8 + 0.3 * ((p.x * 160.0).sin() * (p.y * 160.0).sin()).abs();
        return Vec3::new(0.60, 0.46, 0.24) * carved * (1.0 - 0.5 * line(border(p, size) - 0.024, 0.003));
    }
    let q = p / size;
    let stroke = octaves(Vec2::new(p.x * 50.0, p.y * 130.0), 3, seed ^ 0x5);
    let dusk = unit(1, 1, seed);
    let mut seen = Vec3::new(0.56, 0.70, 0.86).lerp(Vec3::new(0.95, 0.74, 0.52), (1.2 - q.y) * dusk);
    seen = seen.lerp(Vec3::splat(0.94), 0.8 * ramp(0.5, 0.72, octaves(Vec2::new(q.x * 4.0, q.y * 9.0), 4, seed ^ 0x6)));
    for hill in 0..4 {
        let far = 1.0 - hill as f32 / 4.0;
        let crest =
            0.12 + 0.5 * far + 0.22 * (octaves(Vec2::new(q.x * (2.0 + 2.0 * far) + hill as f32 * 9.0, 0.5), 4, seed) - 0.5);
        let near = Vec3::new(0.28, 0.38, 0.16).lerp(Vec3::new(0.62, 0.50, 0.22), unit(hill, 2, seed));
        let tone = near.lerp(Vec3::new(0.55, 0.62, 0.72), far * 0.8);
        let (tree, tag) = spots(p * (30.0 + 20.0 * far), 0.45, seed ^ hill as u32);
        let dotted = tone.lerp(tone * (0.4 + 0.8 * tag), tree * 0.8);
        seen = seen.lerp(dotted, 1.0 - ramp(crest - 0.006, crest + 0.006, q.y));
    }
    seen * (0.80 + 0.36 * stroke)
}

pub fn paper(place: &Place, seed: u32) -> Vec3 {
    let sheet = Vec3::new(0.92, 0.91, 0.87) * (0.97 + 0.04 * octaves(place.uv * 100.0, 2, seed));
    let margin = 0.012;
    let inner = place.size - 2.0 * margin;
    let p = place.uv - margin;
    let picture = border(p - Vec2::new(inner.x * 0.5, 0.0), Vec2::new(inner.x * 0.5, inner.y * 0.35));
    if picture > 0.0 {
        return muted(seed ^ 0x9).lerp(muted(seed ^ 0xA), octaves(p * 40.0, 3, seed));
    }
    sheet.lerp(Vec3::splat(0.15), 0.85 * writing(p, inner, 0.009, seed))
}

/// A packing box: corrugated board, tape, a label, stamped signs.
pub fn cardboard(place: &Place, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    let board = Vec3::new(0.70, 0.54, 0.37) * (0.88 + 0.12 * (p.x * 900.0).sin() * 0.3 + 0.16 * octaves(p * 30.0, 4, seed));
    let tape = 1.0 - ramp(0.024, 0.026, (p.x - size.x * 0.5).abs());
    let taped = board.lerp(Vec3::new(0.80, 0.70, 0.50), tape * 0.7);
    let label = border(p - size * 0.12, Vec2::new(size.x * 0.34, size.y * 0.4));
    if label > 0.0 {
        let ink =
            writing(p - size * 0.12 - 0.006, Vec2::new(size.x * 0.34, size.y * 0.4) - 0.012, 0.011, seed ^ place.chart as u32);
        return Vec3::splat(0.9).lerp(Vec3::splat(0.12), ink);
    }
    let sign = writing(p - Vec2::new(size.x * 0.58, size.y * 0.5), size * Vec2::new(0.36, 0.42), size.y * 0.14, seed ^ 0x516);
    taped.lerp(Vec3::new(0.16, 0.13, 0.12), sign * 0.85) * (0.85 + 0.15 * ramp(0.0, 0.008, border(p, size)))
}

/// A monitor: windows with writing and a plot.
pub fn screen(place: &Place, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    if place.chart >= 4 || border(p, size) < 0.014 || size.min_element() < 0.08 {
        return Vec3::splat(0.12) * (0.9 + 0.3 * octaves(p * 80.0, 2, seed));
    }
    let q = p / size;
    if q.y > 0.9 {
        return Vec3::new(0.30, 0.34, 0.42)
            .lerp(Vec3::splat(0.9), writing(p - Vec2::new(0.02, 0.9 * size.y), size * Vec2::new(0.5, 0.1), 0.014, seed));
    }
    if q.x < 0.55 {
        let ink = writing(p - Vec2::new(0.025, 0.03), size * Vec2::new(0.5, 0.84), 0.010, seed ^ 2);
        let hue = unit((p.x / 0.05) as i32, (p.y / 0.016) as i32, seed);
        return Vec3::new(0.13, 0.15, 0.19).lerp(hsv(hue, 0.5, 0.95), ink);
    }
    let graph = 0.3 + 0.35 * octaves(Vec2::new(q.x * 30.0, 0.3), 4, seed);
    let grid = line((q.x * 20.0).fract() - 0.5, 0.05).max(line((q.y * 12.0).fract() - 0.5, 0.05));
    let field = if q.y < graph { Vec3::new(0.25, 0.55, 0.75) } else { Vec3::splat(0.93) };
    field * (1.0 - 0.25 * grid)
}

/// A keyboard's keys.
pub fn keys(place: &Place, seed: u32) -> Vec3 {
    let cell = (place.uv / 0.019).floor();
    let r = place.uv - cell * 0.019;
    let cap = ramp(0.0015, 0.0025, border(r, Vec2::splat(0.019)));
    let letter = glyph((r - Vec2::new(0.005, 0.006)) / 0.008, hash(cell.x as i32, cell.y as i32, seed));
    Vec3::splat(0.12).lerp(Vec3::splat(0.34), cap).lerp(Vec3::splat(0.85), letter)
}

/// Sky, far trees and a meadow, behind glazing bars.
pub fn window(place: &Place, seed: u32) -> Vec3 {
    let (p, size) = (place.uv, place.size);
    let pane = size / Vec2::new(2.0, 2.0);
    let bar = border(p - (p / pane).floor() * pane, pane);
    if bar < 0.02 || border(p, size) < 0.045 {
        let groove = line(bar - 0.014, 0.002).max(line(border(p, size) - 0.04, 0.002));
        return Vec3::new(0.80, 0.78, 0.74)
            * (0.92 + 0.12 * octaves(Vec2::new(p.x * 40.0, p.y * 200.0), 2, seed))
            * (1.0 - 0.3 * groove);
    }
    let q = p / size;
    let cloud = ramp(0.48, 0.70, octaves(Vec2::new(q.x * 3.0, q.y * 6.0), 5, seed));
    let mut seen = Vec3::new(0.60, 0.76, 0.93).lerp(Vec3::splat(0.96), cloud.max(0.4 - 0.5 * q.y));
    let crest = 0.36 + 0.22 * octaves(Vec2::new(q.x * 7.0, 0.0), 5, seed ^ 3);
    let (crown, tag) = spots(p * 22.0, 0.7, seed ^ 4);
    let foliage = Vec3::new(0.30, 0.45, 0.22) * (0.6 + 0.6 * octaves(p * 60.0, 3, seed ^ 5)) * (0.8 + 0.4 * crown * tag);
    seen = seen.lerp(foliage, 1.0 - ramp(crest - 0.01, crest + 0.01, q.y));
    let (flower, hue) = spots(p * 40.0, 0.22, seed ^ 6);
    let meadow =
        (Vec3::new(0.52, 0.64, 0.30) * (0.7 + 0.5 * octaves(p * 45.0, 4, seed ^ 7))).lerp(hsv(hue, 0.4, 0.95), flower * 0.8);
    seen.lerp(meadow, 1.0 - ramp(0.26, 0.27, q.y))
}
