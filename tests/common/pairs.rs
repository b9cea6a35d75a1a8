//! The tiny recording as rectified pairs in KITTI's layout: what a second eye sees follows from the images and their exact depth.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use image::imageops::interpolate_bilinear;
use image::{DynamicImage, GrayImage, Luma};
use keysplat::geometry::Pinhole;
use keysplat::sequence::{Frame, Sequence};

use super::recording::{recording, scratch};

/// Wide, for depths that are certain in so small images.
const BASELINE_METRES: f64 = 0.6;
/// Rounds in which a pixel's disparity settles.
const ROUNDS: usize = 8;

/// The pairs; tests only read them.
pub fn stereo_recording() -> &'static Path {
    static RECORDING: OnceLock<PathBuf> = OnceLock::new();
    RECORDING.get_or_init(|| {
        let folder = scratch().join("pairs");
        let sequence = Sequence::open(recording(), None, None).unwrap();
        let Pinhole { fx, fy, cx, cy, .. } = sequence.camera.pinhole;
        let shift = -fx * BASELINE_METRES;
        let calibration = format!("P0: {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0\nP1: {fx} 0 {cx} {shift} 0 {fy} {cy} 0 0 0 1 0\n");
        ["image_0", "image_1"].iter().for_each(|eye| std::fs::create_dir_all(folder.join(eye)).unwrap());
        let (mut times, mut poses) = (String::new(), String::new());
        let truth = &sequence.groundtruth.as_ref().unwrap().poses;
        for (index, (entry, pose)) in sequence.entries.iter().zip(truth).enumerate() {
            let frame = sequence.load(index).unwrap();
            right_of(&frame, fx * BASELINE_METRES).save(folder.join(format!("image_1/{index:06}.png"))).unwrap();
            frame.color.save(folder.join(format!("image_0/{index:06}.png"))).unwrap();
            writeln!(times, "{}", entry.timestamp_s).unwrap();
            let rows = pose.world_from_camera.to_matrix().transpose();
            let numbers: Vec<String> = rows.iter().take(12).map(f64::to_string).collect();
            writeln!(poses, "{}", numbers.join(" ")).unwrap();
        }
        for (name, text) in [("calib.txt", calibration), ("times.txt", times), ("poses.txt", poses)] {
            std::fs::write(folder.join(name), text).unwrap();
        }
        folder
    })
}

/// The right eye's image; black where the left one does not look. `scale` is disparity times depth, pixels and metres.
fn right_of(frame: &Frame, scale: f64) -> GrayImage {
    let depth = frame.depth.as_ref().unwrap();
    let left = DynamicImage::from(frame.color.clone()).into_luma8();
    GrayImage::from_fn(depth.width, depth.height, |x, y| {
        let row = &depth.metres[(y * depth.width) as usize..][..depth.width as usize];
        let seen_at = |at: f64| f64::from(x) + scale / f64::from(row[(at.round() as usize).min(row.len() - 1)]);
        let at = (0..ROUNDS).fold(f64::from(x), |at, _| seen_at(at));
        interpolate_bilinear(&left, at as f32, y as f32).unwrap_or(Luma([0]))
    })
}
