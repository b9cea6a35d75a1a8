//! Recorded sequences: what a frame is, and one file per dataset layout that lists and reads them.
//!
//! Adding a layout takes one file and one row in `layouts/mod.rs`.

mod ahead;
mod cameras;
mod checks;
mod error;
mod files;
mod layouts;
mod rectify;
mod sampling;
mod stereo;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{GrayImage, RgbImage};
use layouts::{LayoutRow, Video};
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::geometry::{Camera, Trajectory};

pub use cameras::{ASSUMED as ASSUMED_CAMERA, is_file as is_camera_file};
pub use error::SequenceError;
use files::{decode, existing, files_in, folder_name, images_in, parse_json, read_text};
pub use layouts::Layout;
pub use rectify::{RectifiedImage, Rectifier, Rectifiers};
use stereo::StereoRemap;

/// Sensor of a recording: the images of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensor {
    /// Colour and registered depth.
    Rgbd,
    /// Row-aligned pairs without distortion; the right camera is `baseline_metres` along the left one's x axis.
    Stereo {
        /// Distance between the two cameras, metres.
        baseline_metres: f64,
    },
    /// Colour alone; lengths have no scale.
    Mono,
}

/// Kind of a sensor, without its measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum SensorKind {
    /// Colour and depth.
    Rgbd,
    /// Colour alone.
    Mono,
    /// Rectified pairs.
    Stereo,
}

impl std::fmt::Display for SensorKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Rgbd => "rgbd",
            Self::Mono => "mono",
            Self::Stereo => "stereo",
        })
    }
}

impl Sensor {
    /// The sensor without its measures.
    pub fn kind(self) -> SensorKind {
        match self {
            Self::Rgbd => SensorKind::Rgbd,
            Self::Stereo { .. } => SensorKind::Stereo,
            Self::Mono => SensorKind::Mono,
        }
    }
}

/// A depth image; 0 where the sensor measured nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthImage {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Row-major `[height * width]`, metres along z.
    pub metres: Vec<f32>,
}

impl DepthImage {
    /// The depth at a pixel in metres, `None` where nothing was measured.
    pub fn at(&self, x: u32, y: u32) -> Option<f32> {
        let metres = self.metres[(y * self.width + x) as usize];
        (metres > 0.0).then_some(metres)
    }

    /// Forgets the depth of pixels that are not valid, `[height * width]`.
    fn keep(&mut self, valid: &[bool]) {
        self.metres.iter_mut().zip(valid).filter(|(_, valid)| !**valid).for_each(|(metres, _)| *metres = 0.0);
    }
}

/// One recorded frame as it was recorded, at full size: not undistorted, but for raw stereo pairs, which are rectified.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Position in the sequence as replayed (after `--every` and `--frames`).
    pub index: usize,
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// sRGB.
    pub color: RgbImage,
    /// Registered to `color`, same size.
    pub depth: Option<DepthImage>,
    /// The right camera's image, same size, row-aligned with `color`.
    pub right: Option<GrayImage>,
    /// Same size as `color`; pixels of value 0 are to be ignored.
    pub mask: Option<GrayImage>,
}

impl Frame {
    /// Whether the mask keeps the recorded pixel nearest to `pixel`. Without a mask, all are kept.
    pub fn keeps(&self, pixel: &Vector2<f64>) -> bool {
        let kept = |mask: &GrayImage| {
            let value = mask.get_pixel_checked(pixel.x.round() as u32, pixel.y.round() as u32);
            value.is_some_and(|value| value.0[0] > 0)
        };
        self.mask.as_ref().is_none_or(kept)
    }
}

/// Where one frame lies on disk.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameEntry {
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// An image; or the video whose frame at that time it is.
    pub color: PathBuf,
    /// Depth image, if the frame has one.
    pub depth: Option<PathBuf>,
    /// The right image of a stereo pair.
    pub right: Option<PathBuf>,
    /// Image whose pixels of value 0 are to be ignored.
    pub mask: Option<PathBuf>,
    /// The frame's camera where it is not that of the sequence.
    pub camera: Option<Camera>,
}

/// A point of the scene that came with the recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownPoint {
    /// In the world of the known poses, in their unit.
    pub position: Vector3<f64>,
    /// sRGB.
    pub color: [u8; 3],
}

/// A recording, opened and checked: its camera, the list of its frames, and the truth where there is one.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// Name of the folder or file.
    pub name: String,
    /// Dataset layout.
    pub layout: Layout,
    /// The colour camera; the left one of a stereo pair. The first frame's, where photos have several: see [`Self::camera_of`].
    pub camera: Camera,
    /// Images of a frame.
    pub sensor: Sensor,
    /// Frames in order of time.
    pub entries: Vec<FrameEntry>,
    /// True poses, where the recording has them.
    pub groundtruth: Option<Trajectory>,
    /// Points of the scene in the truth's world, where the recording has them.
    pub points: Vec<KnownPoint>,
    /// Turns raw stereo pairs into those that `camera` and `sensor` describe, when they are loaded.
    remap: Option<Arc<StereoRemap>>,
    /// Source of the frames where they are no image files.
    video: Option<Arc<Video>>,
}

/// Depth that some sensors write where they measured nothing, beside 0 (Kinect's own driver does, hence 7-Scenes).
const NOT_MEASURED: u16 = u16::MAX;

impl Sequence {
    /// Opens a recording, a folder or a video: finds its layout unless named, reads and checks its lists, camera and truth. No image is
    /// decoded, but a video is, once, for the times of its frames.
    /// `camera` names a preset (`tum-fr1`, …), a `camera.toml`, or [`ASSUMED_CAMERA`], to use instead of what a video or a folder of images or in TUM's
    /// layout says.
    ///
    /// # Errors
    /// [`SequenceError`] if the recording does not exist, has no known layout or camera, or a file of it is damaged; the message names the file.
    pub fn open(folder: &Path, layout: Option<Layout>, camera: Option<&str>) -> Result<Self, SequenceError> {
        let video = Layout::video();
        if folder.is_file() && layout.is_none_or(|layout| layout == video) {
            return video.open(folder, camera);
        }
        if !folder.is_dir() {
            return Err(SequenceError::Missing(folder.into()));
        }
        // What a plain folder of images lacks to be recognised, the camera's name gives.
        let bare =
            || camera.filter(|name| *name == ASSUMED_CAMERA || is_camera_file(name)).and_then(|_| Layout::by_name("images"));
        let layout = layout
            .or_else(|| Layout::recognise(folder))
            .or_else(bare)
            .ok_or_else(|| SequenceError::UnknownLayout(folder.into()))?;
        layout.open(folder, camera)
    }

    /// A recording without truth and known points. Frames that bring no camera have `camera`.
    fn new(name: String, layout: &'static LayoutRow, camera: Camera, sensor: Sensor, entries: Vec<FrameEntry>) -> Self {
        let mut sequence = Self {
            name,
            layout: Layout::of(layout),
            camera,
            sensor,
            entries,
            groundtruth: None,
            points: Vec::new(),
            remap: None,
            video: None,
        };
        sequence.share_camera();
        sequence
    }

    /// Makes the first frame's camera that of the sequence; frames of another camera keep theirs.
    fn share_camera(&mut self) {
        let before = self.camera;
        self.camera = self.entries.first().and_then(|entry| entry.camera).unwrap_or(before);
        for entry in &mut self.entries {
            entry.camera = Some(entry.camera.unwrap_or(before)).filter(|camera| *camera != self.camera);
        }
    }

    /// The camera of frame `index`.
    pub fn camera_of(&self, index: usize) -> &Camera {
        self.entries[index].camera.as_ref().unwrap_or(&self.camera)
    }

    /// The frame nearest in time, of two the earlier, if it is no further away than `max_difference_s`.
    pub fn nearest(&self, timestamp_s: f64, max_difference_s: f64) -> Option<usize> {
        let after = self.entries.partition_point(|entry| entry.timestamp_s < timestamp_s);
        let near = after.saturating_sub(1)..(after + 1).min(self.entries.len());
        let distances = near.map(|i| (i, (self.entries[i].timestamp_s - timestamp_s).abs()));
        let nearest = distances.min_by(|a, b| a.1.total_cmp(&b.1))?;
        (nearest.1 <= max_difference_s).then_some(nearest.0)
    }

    /// Whether frames are loaded in any order at the same cost.
    pub fn has_random_access(&self) -> bool {
        self.video.is_none()
    }

    /// The file whose image is frame `index` as a pinhole sees it. None for videos, raw stereo pairs, and cameras with distortion.
    pub fn plain_image(&self, index: usize) -> Option<&Path> {
        let is_plain = self.video.is_none() && self.remap.is_none() && self.camera_of(index).distortion.is_zero();
        is_plain.then_some(&self.entries[index].color)
    }

    /// Whether all frames have one camera.
    pub fn has_one_camera(&self) -> bool {
        self.entries.iter().all(|entry| entry.camera.is_none())
    }

    /// Takes from the recording only what a sensor of this kind gives: a monocular replay of an RGB-D recording leaves its depth out.
    ///
    /// # Errors
    /// [`SequenceError::NoSuchSensor`] if the recording lacks that sensor.
    pub fn restrict_to(&mut self, kind: SensorKind) -> Result<(), SequenceError> {
        if kind == self.sensor.kind() {
            return Ok(());
        }
        if kind != SensorKind::Mono {
            return Err(SequenceError::NoSuchSensor { name: self.name.clone(), wanted: kind, found: self.sensor.kind() });
        }
        self.sensor = Sensor::Mono;
        for entry in &mut self.entries {
            (entry.depth, entry.right) = (None, None);
        }
        Ok(())
    }

    /// Keeps frames `start..end` (the end clipped to the sequence), then every `every`-th of these.
    ///
    /// # Errors
    /// [`SequenceError::Range`] if no frame is left.
    pub fn select(&mut self, range: Option<std::ops::Range<usize>>, every: usize) -> Result<(), SequenceError> {
        let len = self.entries.len();
        let range = range.unwrap_or(0..len);
        if range.start >= range.end || range.start >= len {
            return Err(SequenceError::Range { start: range.start, end: range.end, len });
        }
        let end = range.end.min(len);
        self.entries = self.entries[range.start..end].iter().step_by(every.max(1)).cloned().collect();
        self.share_camera();
        Ok(())
    }

    /// Decodes several frames: images side by side, those of a video one after the other.
    pub fn load_all(&self, indices: &[usize]) -> Vec<Result<Frame, SequenceError>> {
        match &self.video {
            Some(_) => indices.iter().map(|index| self.load(*index)).collect(),
            None => indices.par_iter().map(|index| self.load(*index)).collect(),
        }
    }

    /// Decodes frame `index`. In a video this is quick for the frames after the last one loaded; any other begins at the first again.
    ///
    /// # Errors
    /// [`SequenceError`] if an image is missing, damaged, or not of the camera's size.
    pub fn load(&self, index: usize) -> Result<Frame, SequenceError> {
        let (entry, camera) = (&self.entries[index], self.camera_of(index));
        let color = match &self.video {
            Some(video) => video.load(entry.timestamp_s)?.into(),
            None => decode(&entry.color)?,
        };
        check_size(camera, &entry.color, (color.width(), color.height()))?;
        let color = match &self.remap {
            Some(remap) => remap.left(color),
            None => color.into_rgb8(),
        };
        let depth = entry.depth.as_deref().map(|path| load_depth(camera, path)).transpose()?;
        let right = entry.right.as_deref().map(|path| self.load_right(path)).transpose()?;
        let mask = entry.mask.as_deref().map(|path| load_mask(camera, path)).transpose()?;
        Ok(Frame { index, timestamp_s: entry.timestamp_s, color, depth, right, mask })
    }

    fn load_right(&self, path: &Path) -> Result<GrayImage, SequenceError> {
        let image = decode(path)?.into_luma8();
        check_size(&self.camera, path, image.dimensions())?;
        Ok(match &self.remap {
            Some(remap) => remap.right(&image),
            None => image,
        })
    }

    /// Compares the first images with the camera, so that a wrong calibration is known before any work.
    fn check_first_size(&self) -> Result<(), SequenceError> {
        let first = self.entries.first();
        let paths = first.into_iter().flat_map(|entry| [Some(&entry.color), entry.depth.as_ref(), entry.right.as_ref()]);
        for path in paths.flatten() {
            // A first frame that cannot be read at all is met again, and counted, when it is loaded.
            if let Ok(size) = image::image_dimensions(path) {
                check_size(&self.camera, path, size)?;
            }
        }
        Ok(())
    }

    /// Compares all masks and depth images with their cameras.
    fn check_mask_and_depth_sizes(&self) -> Result<(), SequenceError> {
        for (index, entry) in self.entries.iter().enumerate() {
            for path in [&entry.mask, &entry.depth].into_iter().flatten() {
                let size = image::image_dimensions(path).map_err(|source| SequenceError::Image { path: path.clone(), source })?;
                check_size(self.camera_of(index), path, size)?;
            }
        }
        Ok(())
    }
}

fn load_mask(camera: &Camera, path: &Path) -> Result<GrayImage, SequenceError> {
    let mask = decode(path)?.into_luma8();
    check_size(camera, path, mask.dimensions())?;
    Ok(mask)
}

fn load_depth(camera: &Camera, path: &Path) -> Result<DepthImage, SequenceError> {
    let image::DynamicImage::ImageLuma16(raw) = decode(path)? else {
        return Err(SequenceError::DepthFormat { path: path.into() });
    };
    check_size(camera, path, raw.dimensions())?;
    let metres_per_unit = (1.0 / camera.depth_units_per_metre) as f32;
    let (width, height) = raw.dimensions();
    let metres = |units: &u16| if *units == NOT_MEASURED { 0.0 } else { f32::from(*units) * metres_per_unit };
    Ok(DepthImage { width, height, metres: raw.as_raw().iter().map(metres).collect() })
}

fn check_size(camera: &Camera, path: &Path, (found_width, found_height): (u32, u32)) -> Result<(), SequenceError> {
    let (width, height) = (camera.pinhole.width, camera.pinhole.height);
    if (found_width, found_height) == (width, height) {
        Ok(())
    } else {
        Err(SequenceError::Size { path: path.into(), width, height, found_width, found_height })
    }
}
