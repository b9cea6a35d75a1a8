//! A sample of the frames: whether they can be read, their brightness and texture, and their depth.

use super::{Inspection, measures_depth, quantile};
use crate::sequence::{Frame, Sequence};

/// Frames of the sample, spread over the recording; those of a video come from its beginning, as it has no random access.
const SAMPLED: usize = 24;
/// Mean grey levels outside of which an image is too dark or too bright.
const DARK: f64 = 20.0;
const BRIGHT: f64 = 235.0;
/// Neighbouring pixels that differ by more than this are texture, and the least share of pixels that should be.
const TEXTURE_LEVELS: i32 = 12;
const MIN_TEXTURE: f64 = 0.01;
/// Least share of pixels with depth.
const MIN_DEPTH_SHARE: f64 = 0.2;
/// Plausible median depths of a scene, metres.
const DEPTHS_METRES: std::ops::Range<f64> = 0.25..15.0;
/// Units per metre of known sensors and datasets, most frequent first.
const DEPTH_UNITS: [f64; 5] = [1000.0, 5000.0, 6553.5, 256.0, 10_000.0];
/// Every so many pixels of an image are looked at.
const STRIDE: usize = 7;

struct Sampled {
    brightness: f64,
    texture: f64,
    /// Every so many-th depth, metres; 0 where nothing was measured.
    depths: Option<Vec<f64>>,
}

/// Whether any frame can be read.
pub fn inspect(sequence: &Sequence, found: &mut Inspection) -> bool {
    let frames = sequence.entries.len();
    let count = frames.min(SAMPLED);
    let place = |k: usize| if sequence.has_random_access() { k * frames / count } else { k };
    let loaded = sequence.load_all(&(0..count).map(place).collect::<Vec<_>>());
    let mut failed = Vec::new();
    let mut sampled = Vec::new();
    for frame in loaded {
        match frame {
            Ok(frame) => sampled.push(sample(&frame)),
            Err(error) => failed.push(error),
        }
    }
    if let Some(first) = failed.first() {
        let message = format!("{} of {count} frames cannot be read, the first: {first}", failed.len());
        if sampled.is_empty() { found.problem(message) } else { found.warn(message) }
    }
    if sampled.is_empty() {
        return false;
    }
    brightness(&sampled, found);
    if measures_depth(sequence) {
        depth(sequence, &sampled, found);
    }
    true
}

fn sample(frame: &Frame) -> Sampled {
    let (width, height) = frame.color.dimensions();
    let grey = |x: u32, y: u32| frame.color.get_pixel(x, y).0.iter().map(|v| i32::from(*v)).sum::<i32>() / 3;
    let (mut sum, mut textured, mut count) = (0.0, 0, 0);
    for y in (1..height).step_by(STRIDE) {
        for x in (1..width).step_by(STRIDE) {
            let level = grey(x, y);
            sum += f64::from(level);
            textured += usize::from((level - grey(x - 1, y)).abs().max((level - grey(x, y - 1)).abs()) > TEXTURE_LEVELS);
            count += 1;
        }
    }
    let count = count.max(1) as f64;
    let depths = frame.depth.as_ref().map(|depth| depth.metres.iter().step_by(STRIDE).map(|m| f64::from(*m)).collect());
    Sampled { brightness: sum / count, texture: textured as f64 / count, depths }
}

fn brightness(sampled: &[Sampled], found: &mut Inspection) {
    let mut levels: Vec<f64> = sampled.iter().map(|s| s.brightness).collect();
    levels.sort_by(f64::total_cmp);
    let mut textures: Vec<f64> = sampled.iter().map(|s| s.texture).collect();
    textures.sort_by(f64::total_cmp);
    let (darkest, brightest) = (levels[0], levels[levels.len() - 1]);
    found.fact(
        "images",
        format!(
            "mean grey level {darkest:.0} to {brightest:.0}, texture on {:.0}% of the pixels",
            100.0 * quantile(&textures, 0.5)
        ),
    );
    let too_dark = levels.iter().filter(|level| **level < DARK).count();
    let too_bright = levels.iter().filter(|level| **level > BRIGHT).count();
    for (count, what) in [(too_dark, "nearly black"), (too_bright, "nearly white")] {
        if count > 0 {
            found.warn(format!("{count} of {} frames are {what}: the camera is lost there", sampled.len()));
        }
    }
    let flat = textures.iter().filter(|texture| **texture < MIN_TEXTURE).count();
    if flat > too_dark + too_bright {
        found.warn(format!(
            "{flat} of {} frames have little texture or are blurred: tracking has few corners there",
            sampled.len()
        ));
    }
}

fn depth(sequence: &Sequence, sampled: &[Sampled], found: &mut Inspection) {
    let units = sequence.camera.depth_units_per_metre;
    let images: Vec<&Vec<f64>> = sampled.iter().filter_map(|s| s.depths.as_ref()).collect();
    if images.len() < sampled.len() {
        found.warn(format!("{} of {} frames have no depth image", sampled.len() - images.len(), sampled.len()));
    }
    let all: usize = images.iter().map(|depths| depths.len()).sum();
    let mut measured: Vec<f64> = images.into_iter().flatten().copied().filter(|metres| *metres > 0.0).collect();
    if measured.is_empty() {
        found.problem("no depth image has a measurement: replay without depth by --sensor mono".into());
        return;
    }
    measured.sort_by(f64::total_cmp);
    let share = measured.len() as f64 / all as f64;
    let (near, median, far) = (quantile(&measured, 0.05), quantile(&measured, 0.5), quantile(&measured, 0.95));
    let extent = format!("median {median:.2} m, 90% from {near:.2} to {far:.2} m");
    found.fact("depth", format!("{:.0}% of the pixels, {extent}, {units} units a metre", 100.0 * share));
    if share < MIN_DEPTH_SHARE {
        found.warn(format!("depth covers {:.0}% of the pixels: large parts of the map would be empty", 100.0 * share));
    }
    if !DEPTHS_METRES.contains(&median) {
        let likely = DEPTH_UNITS.iter().find(|other| DEPTHS_METRES.contains(&(median * units / **other)));
        let hint = likely
            .map_or(String::new(), |other| format!("; with {other} units a metre it would be {:.2} m", median * units / other));
        found.warn(format!("a median depth of {median:.3} m is unlikely: check the depth units of the calibration{hint}"));
    }
}
