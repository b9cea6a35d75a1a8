//! Draws the moving picture of the README: recorded frames beside the growing map, from behind the camera.
//!
//! usage: cargo run --release --example growing_map -- RECORDING OUT.gif [MAP_SCALE]

use std::error::Error;
use std::fs::File;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use gif::{Encoder, Frame, Repeat};
use image::{GenericImage, RgbImage, RgbaImage, imageops};
use keysplat::evaluation::views::to_rgb8;
use keysplat::render::{GpuCloud, Rasterizer};
use keysplat::sequence::Rectifier;
use keysplat::splat::{MapSnapshot, ViewCamera};
use keysplat::{Config, Gpu, Progress, Session};
use nalgebra::Translation3;

/// Size of each of the two pictures, pixels.
const WIDTH: u32 = 240;
const HEIGHT: u32 = 180;
/// Distance of the viewpoint behind the recording camera, metres.
const BEHIND_METRES: f64 = 0.7;
/// Time that each keyframe is shown, hundredths of a second; the last one longer.
const DELAY: u16 = 18;
const LAST_DELAY: u16 = 200;
/// Quality and speed of the palette, 1 (best) to 30.
const PALETTE_SPEED: i32 = 10;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (recording, out) = arguments.next().zip(arguments.next()).ok_or("usage: growing_map RECORDING OUT.gif [MAP_SCALE]")?;
    let map_scale = arguments.next().map_or(Ok(0.5), |scale| scale.parse())?;
    let config = Config { map_scale, ..Config::for_recording(&PathBuf::from(recording)) };
    let folder = tempfile::tempdir()?;
    let mut session = Session::open(config, folder.path())?;
    let (progress, done) = (Progress::default(), AtomicBool::new(false));
    let (replay, snapshots) = std::thread::scope(|scope| {
        let snapshots = scope.spawn(|| collect(&progress, &done));
        let replay = session.run(&progress);
        done.store(true, Ordering::Relaxed);
        (replay, snapshots.join().expect("collecting does not panic"))
    });
    let result = replay?.result;
    let sequence = session.recording().sequence();
    let rectifier = Rectifier::new(&sequence.camera, 1.0);
    let mut rasterizer = Rasterizer::new(session.gpu().clone())?;
    let mut encoder = Encoder::new(File::create(out)?, (2 * WIDTH) as u16, HEIGHT as u16, &[])?;
    encoder.set_repeat(Repeat::Infinite)?;
    for (i, snapshot) in snapshots.iter().enumerate() {
        let Some(keyframe) = snapshot.keyframes.checked_sub(1).and_then(|newest| result.keyframes.get(newest)) else { continue };
        let world_from_view = keyframe.world_from_camera * Translation3::new(0.0, 0.0, -BEHIND_METRES);
        let scale = f64::from(WIDTH) / f64::from(sequence.camera.pinhole.width);
        let camera = ViewCamera { pinhole: sequence.camera.pinhole.scaled(scale), camera_from_world: world_from_view.inverse() };
        let map = on_gpu(session.gpu(), snapshot)?;
        let rendered = to_rgb8(&rasterizer.render(&map, &camera, [0.0; 3])?);
        let recorded = rectifier.rectify(&sequence.load(keyframe.frame_index)?).color;
        let delay = if i + 1 == snapshots.len() { LAST_DELAY } else { DELAY };
        encoder.write_frame(&pair(&recorded, &rendered, delay)?)?;
    }
    Ok(())
}

/// Every snapshot of the run: the mapper takes longer for a keyframe than this thread to look.
fn collect(progress: &Progress, done: &AtomicBool) -> Vec<MapSnapshot> {
    let mut snapshots: Vec<MapSnapshot> = Vec::new();
    while !done.load(Ordering::Relaxed) {
        let newest = progress.snapshots().get().map(|snapshot| (*snapshot).clone());
        progress.snapshots().want();
        if let Some(snapshot) = newest {
            // Pose updates publish a keyframe's map again; the newest counts.
            snapshots.retain(|earlier| earlier.keyframes != snapshot.keyframes);
            snapshots.push(snapshot);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    snapshots
}

fn on_gpu(gpu: &Arc<Gpu>, snapshot: &MapSnapshot) -> Result<GpuCloud, Box<dyn Error>> {
    Ok(GpuCloud::of(gpu, &snapshot.cloud)?)
}

/// Recorded left, map right.
fn pair(recorded: &RgbImage, rendered: &RgbImage, delay: u16) -> Result<Frame<'static>, Box<dyn Error>> {
    let mut picture = RgbImage::new(2 * WIDTH, HEIGHT);
    picture.copy_from(&imageops::thumbnail(recorded, WIDTH, HEIGHT), 0, 0)?;
    picture.copy_from(&imageops::thumbnail(rendered, WIDTH, HEIGHT), WIDTH, 0)?;
    let mut rgba: RgbaImage = image::DynamicImage::from(picture).into_rgba8();
    let mut frame = Frame::from_rgba_speed((2 * WIDTH) as u16, HEIGHT as u16, &mut rgba, PALETTE_SPEED);
    frame.delay = delay;
    Ok(frame)
}
