//! What a keyframe costs the mapping thread itself, and what passes between it and the adapter: on a fast GPU this is what limits the mapper.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use cpu_time::ThreadTime;
use fastrand::Rng;
use image::{Rgb, RgbImage};
use nalgebra::Vector2;
use serde::Serialize;

use crate::geometry::{Pinhole, Se3};
use crate::gpu::Gpu;
use crate::mapping::{HostTimes, Keyframe, Mapper, MappingConfig, MappingError};
use crate::sequence::{DepthImage, KnownPoint, RectifiedImage};

/// What to measure.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct HostBench {
    /// Gaussians in the map at first.
    pub gaussians: usize,
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Measured keyframes.
    pub keyframes: usize,
}

/// Means over the keyframes.
#[derive(Clone, Debug, Serialize)]
pub struct HostReport {
    /// The measured configuration.
    pub bench: HostBench,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// CPU time of the mapping thread for each keyframe by part, milliseconds.
    pub parts_ms: BTreeMap<&'static str, f64>,
    /// All of the thread's CPU time for a keyframe, the parts and what is between them, milliseconds.
    pub total_ms: f64,
    /// Blocking waits, at most.
    pub waits: u64,
    /// Bytes read back, at most.
    pub bytes_read: u64,
    /// Uploads, at most.
    pub uploads: u64,
}

/// A camera that moves along a textured wall in front of boxes, over a map that has most of it.
///
/// # Errors
/// [`MappingError`] if a buffer does not fit or the device fails.
pub fn bench_host(gpu: &Arc<Gpu>, bench: HostBench) -> Result<HostReport, MappingError> {
    let config = MappingConfig { first_iterations: 1, ..MappingConfig::default() };
    let mut mapper = Mapper::new(gpu.clone(), &config)?;
    mapper.add_points(&points(&bench), 0)?;
    // The first two pay for buffers and shaders.
    for id in 0..2 {
        mapper.insert(&keyframe(id, &bench), &|| false)?;
    }
    let parts = |times: &HostTimes| times.parts().collect::<BTreeMap<_, _>>();
    let before = parts(mapper.host_times());
    let (mut waits, mut bytes_read, mut uploads) = (0, 0, 0);
    let mut total = Duration::ZERO;
    for id in (2..).take(bench.keyframes) {
        let earlier = gpu.traffic();
        let keyframe = keyframe(id, &bench);
        let started = ThreadTime::now();
        mapper.insert(&keyframe, &|| false)?;
        total += started.elapsed();
        let traffic = gpu.traffic() - earlier;
        waits = waits.max(traffic.waits);
        bytes_read = bytes_read.max(traffic.bytes_read);
        uploads = uploads.max(traffic.uploads);
    }
    let ms = |time: Duration| time.as_secs_f64() * 1e3 / bench.keyframes.max(1) as f64;
    let own = |part, time: Duration| ms(time - before.get(part).copied().unwrap_or_default());
    let parts_ms = mapper.host_times().parts().map(|(part, time)| (part, own(part, time))).collect();
    let total_ms = ms(total);
    Ok(HostReport { bench, gaussians: mapper.gaussians(), parts_ms, total_ms, waits, bytes_read, uploads })
}

fn pinhole(bench: &HostBench) -> Pinhole {
    let (width, height) = (bench.width, bench.height);
    let focal = f64::from(width) * 0.8;
    Pinhole { fx: focal, fy: focal, cx: f64::from(width) / 2.0 - 0.5, cy: f64::from(height) / 2.0 - 0.5, width, height }
}

/// Depth in metres at a pixel, the same from all views that are a few centimetres apart.
fn metres(x: u32, y: u32, bench: &HostBench) -> f32 {
    let (columns, rows) = (8 * x / bench.width, 6 * y / bench.height);
    if (columns + rows).is_multiple_of(3) { 1.8 } else { 2.5 }
}

fn color(x: u32, y: u32) -> Rgb<u8> {
    let wave = |k: u32| 128.0 + 60.0 * ((x * (k + 2)) as f32 * 0.05).sin() + 50.0 * ((y * (5 - k)) as f32 * 0.04).cos();
    Rgb([0, 1, 2].map(|k| wave(k) as u8))
}

fn keyframe(id: usize, bench: &HostBench) -> Keyframe {
    let (width, height) = (bench.width, bench.height);
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    // A sensor's holes.
    let depth = pixels().map(|(x, y)| if (x / 5 + y / 7).is_multiple_of(41) { 0.0 } else { metres(x, y, bench) });
    let image = RectifiedImage {
        pinhole: pinhole(bench),
        color: RgbImage::from_fn(width, height, color),
        depth: Some(DepthImage { width, height, metres: depth.collect() }),
        valid: None,
    };
    let world_from_camera = Se3::translation(0.02 * id as f64, 0.0, 0.0);
    Keyframe { covisible: (0..id).rev().take(5).collect(), ..Keyframe::new(id, world_from_camera, image) }
}

fn points(bench: &HostBench) -> Vec<KnownPoint> {
    let (mut rng, pinhole) = (Rng::with_seed(1), pinhole(bench));
    let mut point = || {
        let (x, y) = (rng.u32(..bench.width), rng.u32(..bench.height));
        let at = Vector2::new(f64::from(x) + rng.f64() - 0.5, f64::from(y) + rng.f64() - 0.5);
        let position = pinhole.unproject(&at, f64::from(metres(x, y, bench)));
        KnownPoint { position, color: color(x, y).0 }
    };
    (0..bench.gaussians).map(|_| point()).collect()
}
