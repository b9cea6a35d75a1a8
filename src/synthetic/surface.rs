//! Baked surfaces: the lit texture of one chart with its mip levels, and filtered look-up.
//!
//! Since light and texture do not depend on the viewer, both are computed once per texel; a pixel then averages the texels under
//! its footprint (trilinear, several taps along the longer axis), which keeps fine texture from aliasing.

use glam::{DVec2, Vec2, Vec3, Vec4};

/// Linear radiance of the highest stored value.
const FULL_SCALE: f32 = 2.0;
/// Most look-ups along a stretched footprint.
const MAX_TAPS: f32 = 4.0;
/// Most texels along a side; larger charts get coarser texels.
const MAX_SIDE: f64 = 6000.0;

/// Whole texels by which look-ups may leave a chart to the left or below before they are clipped.
const OFFSET: f32 = 64.0;

struct Level {
    width: usize,
    height: usize,
    /// Row-major, linear, `FULL_SCALE` at 65535; the fourth is there for the width of a register.
    texels: Vec<[u16; 4]>,
}

pub struct Surface {
    levels: Vec<Level>,
    texels_per_metre: Vec2,
    wraps: bool,
}

impl Surface {
    /// Evaluates `color` (linear radiance at a place in metres) on texels of about `texel_metres`.
    pub fn bake(size: DVec2, texel_metres: f64, wraps: bool, color: impl Fn(DVec2) -> Vec3) -> Self {
        let count = |metres: f64| (metres / texel_metres).ceil().clamp(1.0, MAX_SIDE);
        let (width, height) = (count(size.x), count(size.y));
        let step = DVec2::new(size.x / width, size.y / height);
        let (width, height) = (width as usize, height as usize);
        let texels = (0..width * height)
            .map(|i| encode(color(DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5) * step)))
            .collect();
        let mut levels = vec![Level { width, height, texels }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Self { levels, texels_per_metre: step.recip().as_vec2(), wraps }
    }

    /// Mean over a pixel's footprint at `uv` (metres), whose sides are `dx` and `dy` (metres).
    pub fn sample(&self, uv: DVec2, dx: DVec2, dy: DVec2) -> Vec3 {
        let at = uv.as_vec2() * self.texels_per_metre;
        let (dx, dy) = (dx.as_vec2() * self.texels_per_metre, dy.as_vec2() * self.texels_per_metre);
        let (major, area) = (if dx.length_squared() > dy.length_squared() { dx } else { dy }, dx.perp_dot(dy).abs());
        let length = major.length().max(1e-6);
        let taps = (length * length / area.max(1e-9)).round().clamp(1.0, MAX_TAPS);
        let width = (area / length).max(length / taps);
        let level = rough_log2(width.max(1.0));
        let mut sum = Vec4::ZERO;
        for tap in 0..taps as u32 {
            sum += self.trilinear(at + major * ((tap as f32 + 0.5) / taps - 0.5), level);
        }
        (sum * (FULL_SCALE / 65535.0 / taps)).truncate()
    }

    #[inline]
    fn trilinear(&self, at: Vec2, level: f32) -> Vec4 {
        let last = self.levels.len() - 1;
        let low = (level as usize).min(last);
        let blend = level - low as f32;
        let fine = self.levels[low].bilinear(self.scaled(at, low), self.wraps);
        if blend < 0.01 || low == last {
            return fine;
        }
        fine.lerp(self.levels[low + 1].bilinear(self.scaled(at, low + 1), self.wraps), blend)
    }

    fn scaled(&self, at: Vec2, level: usize) -> Vec2 {
        let (full, this) = (&self.levels[0], &self.levels[level]);
        at * Vec2::new(this.width as f32 / full.width as f32, this.height as f32 / full.height as f32)
    }
}

impl Level {
    #[inline]
    fn bilinear(&self, at: Vec2, wraps: bool) -> Vec4 {
        // Floors by casts of non-negative numbers, since `floor` is a call on plain x86-64.
        let p = at.max(Vec2::splat(0.5 - OFFSET)) + (OFFSET - 0.5);
        let (x, y) = (p.x as i32, p.y as i32);
        let f = Vec2::new(p.x - x as f32, p.y - y as f32);
        let (x, y) = (x - OFFSET as i32, y - OFFSET as i32);
        let column = |x: i32| if wraps { x.rem_euclid(self.width as i32) } else { x.clamp(0, self.width as i32 - 1) } as usize;
        let row = |y: i32| y.clamp(0, self.height as i32 - 1) as usize * self.width;
        let (x0, x1, y0, y1) = (column(x), column(x + 1), row(y), row(y + 1));
        let fetch = |i: usize| Vec4::from(self.texels[i].map(|v| i32::from(v) as f32));
        let bottom = fetch(y0 + x0).lerp(fetch(y0 + x1), f.x);
        let top = fetch(y1 + x0).lerp(fetch(y1 + x1), f.x);
        bottom.lerp(top, f.y)
    }

    /// The next level: each texel the mean of the four (or fewer) under it.
    fn halved(&self) -> Option<Self> {
        if self.width == 1 && self.height == 1 {
            return None;
        }
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            let rows = [2 * y, (2 * y + 1).min(self.height - 1)].map(|r| r * self.width);
            for x in 0..width {
                let columns = [2 * x, (2 * x + 1).min(self.width - 1)];
                texels.push(std::array::from_fn(|c| {
                    let sum: u32 = rows.iter().flat_map(|r| columns.map(|x| u32::from(self.texels[r + x][c]))).sum();
                    ((sum + 2) / 4) as u16
                }));
            }
        }
        Some(Self { width, height, texels })
    }
}

/// The logarithm to base 2 with a straight line between powers of two, which is also how levels are blended.
fn rough_log2(v: f32) -> f32 {
    let bits = v.to_bits();
    ((bits >> 23) as f32 - 127.0) + (bits & 0x7F_FFFF) as f32 / 8_388_608.0
}

fn encode(radiance: Vec3) -> [u16; 4] {
    (radiance.extend(0.0).clamp(Vec4::ZERO, Vec4::splat(FULL_SCALE)) * (65535.0 / FULL_SCALE) + 0.5).to_array().map(|v| v as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stripes finer than a pixel must fade to their mean, seen straight on and at a slant.
    #[test]
    fn detail_below_the_footprint_fades_to_its_mean() {
        let stripes = |uv: DVec2| Vec3::splat(if (uv.x * 250.0).fract() < 0.5 { 0.9 } else { 0.1 });
        let surface = Surface::bake(DVec2::ONE, 0.001, false, stripes);
        for dy in [0.03, 0.1] {
            for k in 0..50 {
                let seen =
                    surface.sample(DVec2::new(0.3 + 0.0007 * f64::from(k), 0.5), DVec2::new(0.03, 0.0), DVec2::new(0.0, dy));
                assert!((seen.x - 0.5).abs() < 0.02, "{seen}");
            }
        }
        let near = surface.sample(DVec2::new(0.401, 0.5), DVec2::new(0.0005, 0.0), DVec2::new(0.0, 0.0005));
        assert!((near.x - 0.9).abs() < 0.01);
    }
}
