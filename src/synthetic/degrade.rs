//! The sensor: exposure and tone, noise, lost depth, a covered lens. Turns a rendered frame into the numbers of the files.

use std::sync::LazyLock;

use fastrand::Rng;
use glam::{Vec2, Vec3};

use super::config::{DegradationConfig, SceneConfig};
use super::noise::{octaves, unit};
use super::render::Rendered;

/// Depth image value of one metre.
pub const DEPTH_UNITS_PER_METRE: f64 = 5000.0;
/// Below this cosine between normal and ray, structured light comes back too weak (where depth is lost at all).
const GRAZING: f32 = 0.12;
/// Blobs of lost depth are about this share of the image's width.
const BLOB: f32 = 0.08;
/// Radiance up to here is shown in proportion; the rest is compressed into what is left.
const KNEE: f32 = 0.65;
const TONE_STEPS: usize = 8192;
/// Radiance at the end of the tone table.
const TONE_END: f32 = 4.0;

/// 8-bit level (with fraction) for the square root of radiance, which spends the steps where the eye does.
static TONE: LazyLock<Vec<f32>> = LazyLock::new(|| {
    let level = |i: usize| {
        let root = i as f32 / (TONE_STEPS - 1) as f32;
        let radiance = root * root * TONE_END;
        let room = 1.0 - KNEE;
        let kept = if radiance < KNEE { radiance } else { KNEE + room * (1.0 - (-(radiance - KNEE) / room).exp()) };
        let shown = if kept < 0.003_130_8 { kept * 12.92 } else { 1.055 * kept.powf(1.0 / 2.4) - 0.055 };
        shown * 255.0
    };
    (0..TONE_STEPS).map(level).collect()
});

/// The finished frame: `rgb` interleaved, `depth` in sensor units, 0 where nothing was measured.
pub struct Recorded {
    pub rgb: Vec<u8>,
    pub depth: Vec<u16>,
}

pub struct Sensor {
    settings: DegradationConfig,
    seed: u64,
    fps: f64,
    width: usize,
}

impl Sensor {
    pub fn new(config: &SceneConfig) -> Self {
        Self { settings: config.degradation.clone(), seed: config.seed, fps: config.fps, width: config.camera.width as usize }
    }

    /// What a camera (0: the only or the left one) records of a frame.
    pub fn record(&self, rendered: &Rendered, frame: usize, camera: usize) -> Recorded {
        let mut rng = Rng::with_seed(self.seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ frame as u64 ^ (camera as u64) << 32);
        let covered = self.settings.covered.is_some_and(|[from, to]| (from..to).contains(&frame));
        let gain = if covered { Vec3::ZERO } else { self.gain(frame as f64 / self.fps) };
        let noise = self.settings.image_noise as f32;
        let mut rgb = Vec::with_capacity(rendered.color.len() * 3);
        for color in &rendered.color {
            for radiance in (*color * gain).to_array() {
                let root = (radiance / TONE_END).sqrt().min(1.0);
                let mut level = TONE[(root * (TONE_STEPS - 1) as f32 + 0.5) as usize];
                if noise > 0.0 {
                    level += noise * normal(&mut rng);
                }
                rgb.push((level + 0.5).clamp(0.0, 255.0) as u8);
            }
        }
        let depth = if covered { vec![0; rendered.color.len()] } else { self.depth(rendered, frame, &mut rng) };
        Recorded { rgb, depth }
    }

    /// Gain per channel: exposure and white balance wander over tens of seconds.
    fn gain(&self, t_s: f64) -> Vec3 {
        let amount = self.settings.exposure_drift;
        let wander = |salt: u32| {
            let phase = |k: i32| f64::from(unit(k, 0, salt ^ self.seed as u32)) * std::f64::consts::TAU;
            0.6 * (0.9 * t_s + phase(0)).sin() + 0.4 * (0.37 * t_s + phase(1)).sin()
        };
        let [all, red, blue] = [wander(1), 0.3 * wander(2), 0.3 * wander(3)].map(|w| w * amount);
        Vec3::new((all + red).exp() as f32, all.exp() as f32, (all + blue).exp() as f32)
    }

    fn depth(&self, rendered: &Rendered, frame: usize, rng: &mut Rng) -> Vec<u16> {
        let s = &self.settings;
        let (losing, range, quadratic) = (s.missing_depth > 0.0, s.max_range as f32, s.depth_noise as f32);
        let blobs =
            losing.then(|| Blobs::new(s.missing_depth, self.seed as u32 ^ 0xB10B, frame, self.width, rendered.color.len()));
        let measure = |(i, g): (usize, &super::render::Geometry)| {
            let z = g.depth_metres;
            let noise = if quadratic > 0.0 { quadratic * z * z * normal(rng) } else { 0.0 };
            let lost = (range > 0.0 && z > range) || blobs.as_ref().is_some_and(|b| g.facing < GRAZING || b.cover(i));
            let units = (f64::from(z + noise) * DEPTH_UNITS_PER_METRE).round();
            if lost || !(1.0..=65_535.0).contains(&units) { 0 } else { units as u16 }
        };
        rendered.geometry.iter().enumerate().map(measure).collect()
    }
}

/// Holes in the depth image that drift slowly over it.
struct Blobs {
    width: usize,
    scale: f32,
    drift: Vec2,
    threshold: f32,
    seed: u32,
}

impl Blobs {
    /// Sets the threshold so that `share` of the image is covered, counted on a sparse grid.
    fn new(share: f64, seed: u32, frame: usize, width: usize, pixels: usize) -> Self {
        let scale = 1.0 / (BLOB * width as f32);
        let drift = Vec2::new(0.031, 0.017) * frame as f32;
        let mut this = Self { width, scale, drift, threshold: 0.0, seed };
        let step = (pixels / 4000).max(1);
        let mut field: Vec<f32> = (0..pixels).step_by(step).map(|i| this.field(i)).collect();
        field.sort_by(f32::total_cmp);
        this.threshold = field[((field.len() - 1) as f64 * share) as usize];
        this
    }

    fn field(&self, i: usize) -> f32 {
        let p = Vec2::new((i % self.width) as f32, (i / self.width) as f32);
        octaves(p * self.scale + self.drift, 3, self.seed)
    }

    fn cover(&self, i: usize) -> bool {
        self.field(i) < self.threshold
    }
}

/// A normal number, as the sum of four uniform ones (it ends at 3.5 standard deviations, as sensors' noise may).
fn normal(rng: &mut Rng) -> f32 {
    let bits = rng.u64(..);
    let sum: u32 = (0..4).map(|k| (bits >> (16 * k)) as u32 & 0xFFFF).sum();
    // Variance of the sum of four uniform numbers of width 65536: 4 · 65536² / 12.
    (sum as f32 - 131_070.0) / 37_837.2
}
