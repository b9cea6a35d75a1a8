//! Photos with a sparse model by COLMAP (Schönberger & Frahm, *Structure-from-Motion Revisited*, CVPR 2016).
//!
//! `images/` beside `sparse/0/` (or `sparse/`) with `cameras`, `images` and `points3D`, each `.bin` or `.txt`. The poses are known: they
//! become the truth, and the points with their colours seed a map. Photos have no times: sorted by name, the n-th listed one has the
//! timestamp of n seconds. Up to half of them may be missing. COLMAP's pixels count from the image's corner, ours from the first pixel's
//! centre: principal points move by half a pixel.
//!
//! Left out: fisheye lenses, which are refused.

pub(super) mod binary;
pub(super) mod text;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use super::row::{LayoutRow, parse_text};
use crate::geometry::{Camera, Distortion, Pinhole, Se3, StampedPose, Trajectory};
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, checks, existing, folder_name, read_text};
use binary::Records;

/// COLMAP's camera models in the order of their numbers, with how many parameters each has.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// A camera as the model has it.
pub(super) struct ModelCamera {
    id: u32,
    model: String,
    width: u64,
    height: u64,
    parameters: Vec<f64>,
}

/// A photo and where it was taken.
pub(super) struct KnownImage {
    /// Path below `images/`.
    name: String,
    /// The number of its camera.
    camera: u32,
    camera_from_world: Se3,
}

/// The folder of the model, where there is one.
fn model_folder(folder: &Path) -> Option<PathBuf> {
    let has_cameras = |model: &PathBuf| ["cameras.bin", "cameras.txt"].iter().any(|name| model.join(name).is_file());
    ["sparse/0", "sparse"].map(|model| folder.join(model)).into_iter().find(has_cameras)
}

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "colmap",
    marker: "images and sparse/0",
    help: "`images` and COLMAP's model of them in `sparse/0`, binary or text: photos with known poses.",
    is_photos: true,
    takes_camera: false,
    recognise,
    open: |folder, _| open(folder),
    parse,
};

fn recognise(folder: &Path) -> bool {
    folder.join("images").is_dir() && model_folder(folder).is_some()
}

fn open(folder: &Path) -> Result<Sequence, SequenceError> {
    let model = model_folder(folder).ok_or_else(|| SequenceError::Missing(folder.join("sparse/0")))?;
    let (cameras, cameras_path) = read(&model, "cameras", binary::cameras, text::cameras)?;
    let (mut images, images_path) = read(&model, "images", binary::images, text::images)?;
    // A model without points is one without a seed.
    let has_points = ["points3D.bin", "points3D.txt"].iter().any(|name| model.join(name).is_file());
    let points = if has_points { read(&model, "points3D", binary::points, text::points)?.0 } else { Vec::new() };
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let cameras = cameras_of(&images, &cameras).map_err(|what| SequenceError::Content { path: cameras_path, what })?;
    let found = images.into_iter().enumerate().map(|(index, image)| {
        let timestamp_s = index as f64;
        let color = folder.join("images").join(&image.name);
        let entry = FrameEntry { timestamp_s, color, camera: Some(cameras[&image.camera]), ..FrameEntry::default() };
        let pose = StampedPose { timestamp_s, world_from_camera: image.camera_from_world.inverse() };
        if entry.color.is_file() { Ok((entry, pose)) } else { Err(image.name) }
    });
    let (entries, poses): (Vec<FrameEntry>, Vec<StampedPose>) = existing(&images_path, found.collect())?.into_iter().unzip();
    let camera = entries.first().and_then(|entry| entry.camera).ok_or(SequenceError::Empty { path: images_path })?;
    let groundtruth = Trajectory { poses };
    let sequence = Sequence {
        points,
        groundtruth: Some(groundtruth),
        ..Sequence::new(folder_name(folder), &LAYOUT, camera, Sensor::Mono, entries)
    };
    sequence.check_first_size()?;
    Ok(sequence)
}

/// The cameras that the images have, by their numbers.
fn cameras_of(images: &[KnownImage], cameras: &[ModelCamera]) -> Result<BTreeMap<u32, Camera>, String> {
    let wanted: BTreeSet<u32> = images.iter().map(|image| image.camera).collect();
    let found = wanted.into_iter().map(|number| {
        let camera = cameras.iter().find(|camera| camera.id == number);
        Ok((number, camera_of(camera.ok_or_else(|| format!("there is no camera {number}, which images have"))?)?))
    });
    found.collect()
}

/// Reads one part of the model from the form that it has; the binary one goes first, as COLMAP's tools do it.
fn read<T>(
    model: &Path,
    part: &str,
    binary: impl Fn(Records<File>) -> Result<T, SequenceError>,
    text: impl Fn(&str, &Path) -> Result<T, SequenceError>,
) -> Result<(T, PathBuf), SequenceError> {
    let path = model.join(format!("{part}.bin"));
    if path.is_file() {
        return Ok((binary(Records::open(&path)?)?, path));
    }
    let path = model.join(format!("{part}.txt"));
    Ok((text(&read_text(&path)?, &path)?, path))
}

/// The camera, if its model is one that we know.
pub(super) fn camera_of(camera: &ModelCamera) -> Result<Camera, String> {
    let model = camera.model.as_str();
    let (fx, fy, cx, cy, [k1, k2, p1, p2]) = match (model, camera.parameters.as_slice()) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => (f, f, cx, cy, [0.0; 4]),
        ("PINHOLE", &[fx, fy, cx, cy]) => (fx, fy, cx, cy, [0.0; 4]),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => (f, f, cx, cy, [k, 0.0, 0.0, 0.0]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => (f, f, cx, cy, [k1, k2, 0.0, 0.0]),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => (fx, fy, cx, cy, [k1, k2, p1, p2]),
        ("SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV", parameters) => {
            return Err(format!("a {model} camera does not have {} parameters", parameters.len()));
        }
        _ => {
            let known = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV";
            return Err(format!(
                "{model} cameras are not known here; undistort the photos with COLMAP's image_undistorter, or use {known}"
            ));
        }
    };
    let side = |pixels| checks::side(pixels).ok_or_else(|| format!("{pixels} pixels are no size of an image"));
    let pinhole = Pinhole { fx, fy, cx: cx - 0.5, cy: cy - 0.5, width: side(camera.width)?, height: side(camera.height)? };
    checks::camera(Camera { pinhole, distortion: Distortion { k1, k2, p1, p2, k3: 0.0 }, depth_units_per_metre: 1.0 })
}

/// The three parts of a model, each as text and as binary.
fn parse(bytes: &[u8]) -> Vec<Result<(), SequenceError>> {
    let path = Path::new("file");
    let records = || Records::new(Cursor::new(bytes), bytes.len() as u64, path);
    let known = |cameras: Vec<ModelCamera>| cameras.iter().for_each(|camera| drop(camera_of(camera)));
    let mut results =
        vec![binary::cameras(records()).map(known), binary::images(records()).map(drop), binary::points(records()).map(drop)];
    results.extend(parse_text(bytes, |text, path| {
        vec![text::cameras(text, path).map(known), text::images(text, path).map(drop), text::points(text, path).map(drop)]
    }));
    results
}
