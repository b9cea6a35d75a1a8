//! A run's images, poses and points as a dataset for other trainers.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{GrayImage, ImageBuffer, ImageFormat, Luma};
use rayon::prelude::*;

use super::SessionError;
use super::evaluate::{EvaluateOptions, nearest_frames, read_trajectory, resolve};
use crate::export::ExportFilter;
use crate::export::dataset::{
    DEPTH, DatasetFormat, IMAGES, MASKS, PosedImage, SurfacePoint, depth_name, mask_name, surface_points,
};
use crate::files::{WriteError, write_atomically};
use crate::geometry::Se3;
use crate::recording::Recording;
use crate::run_folder::OutputError;
use crate::run_folder::outputs::{self, find_map};
use crate::sequence::{DepthImage, Frame, Rectifier, Rectifiers, SequenceError};

/// Which of a run's images a dataset has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum DatasetViews {
    /// Those of the keyframes.
    #[default]
    Keyframes,
    /// All that have a pose.
    All,
}

/// What of a run is written, and how.
#[derive(Clone, Debug)]
pub struct DatasetOptions {
    /// Layout of the files.
    pub format: DatasetFormat,
    /// Images.
    pub views: DatasetViews,
    /// The part of the map whose centres become points.
    pub points: ExportFilter,
    /// The recording, where it has moved.
    pub sequence: Option<PathBuf>,
}

/// How much was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DatasetCounts {
    /// Images with poses.
    pub images: usize,
    /// Points.
    pub points: usize,
    /// Frames that could not be read.
    pub unreadable: usize,
}

/// Frames decoded and written side by side.
const BATCH: usize = 8;
/// Endings of images that every trainer reads: such files are copied as they are.
const PLAIN: [&str; 3] = ["png", "jpg", "jpeg"];
/// Least opacity of a Gaussian on a surface.
const SURFACE_OPACITY: f32 = 0.5;
const MILLIMETRES: f32 = 1e3;

/// Writes the images of a run's folder with their poses, and the map's centres as points, into an empty or new folder. Poses are written last: a folder
/// without them was not finished. `on_image` receives the number of images so far.
///
/// # Errors
/// If the folder has files, the run's folder lacks poses, the recording cannot be opened, no frame can be read, or a file cannot be written.
pub fn export_dataset(
    run: &Path,
    out: &Path,
    options: &DatasetOptions,
    on_image: &(dyn Fn(usize) + Sync),
) -> Result<DatasetCounts, SessionError> {
    let name = match options.views {
        DatasetViews::Keyframes => outputs::KEYFRAMES,
        DatasetViews::All => outputs::TRAJECTORY,
    };
    let poses_file = run.join(name);
    if !poses_file.is_file() {
        return Err(SessionError::Missing { path: poses_file, advice: "give the folder of a finished run" });
    }
    if std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some()) || out.is_file() {
        return Err(SessionError::NotEmpty { folder: out.into() });
    }
    let evaluate = EvaluateOptions { sequence: options.sequence.clone(), map_scale: Some(1.0), adapter: None };
    let recording = Recording::open(resolve(run, &evaluate)?)?;
    let trajectory = read_trajectory(&poses_file)?;
    let mut poses = nearest_frames(recording.sequence(), &trajectory);
    // Of two poses near one frame, the earlier.
    poses.sort_by_key(|(frame, _)| *frame);
    poses.dedup_by_key(|(frame, _)| *frame);
    let points = points(run, &options.points)?;
    let writer = Writer { recording: &recording, out, has_depth: options.format.has_depth() };
    let (images, unreadable) = writer.images(&poses, on_image)?;
    if images.is_empty() {
        return Err(SessionError::Missing {
            path: out.join(IMAGES),
            advice: "not one frame of the recording could be read; look at its files with keysplat check, or name the recording with --sequence",
        });
    }
    options.format.write(out, &images, &points).map_err(OutputError::from)?;
    Ok(DatasetCounts { images: images.len(), points: points.len(), unreadable })
}

/// Centres of the run's map, if it has one.
fn points(run: &Path, filter: &ExportFilter) -> Result<Vec<SurfacePoint>, SessionError> {
    let Some((path, format)) = find_map(run) else { return Ok(Vec::new()) };
    let cloud = format.read(&path).map_err(OutputError::from)?;
    let filter = ExportFilter { min_opacity: filter.min_opacity.or(Some(SURFACE_OPACITY)), ..*filter };
    Ok(surface_points(&filter.apply(&cloud)))
}

struct Writer<'a> {
    recording: &'a Recording,
    out: &'a Path,
    has_depth: bool,
}

type Loaded = Result<Frame, SequenceError>;
/// An image that was written; none where the frame cannot be read.
type Written = Result<Option<PosedImage>, WriteError>;

impl Writer<'_> {
    /// Writes the images; returns them in the order of time, and how many frames could not be read.
    fn images(&self, poses: &[(usize, Se3)], on_image: &(dyn Fn(usize) + Sync)) -> Result<(Vec<PosedImage>, usize), OutputError> {
        let sequence = self.recording.sequence();
        let mut rectifiers = Rectifiers::new(1.0);
        let (mut images, mut unreadable) = (Vec::new(), 0);
        for batch in poses.chunks(BATCH) {
            let frames = sequence.load_all(&batch.iter().map(|(index, _)| *index).collect::<Vec<usize>>());
            let rectifiers: Vec<_> = batch.iter().map(|(index, _)| rectifiers.of(sequence.camera_of(*index))).collect();
            let write = |((posed, frame), rectifier): ((&(usize, Se3), Loaded), Arc<Rectifier>)| match frame {
                Ok(frame) => self.image(&frame, posed.1, &rectifier).map(Some),
                Err(error) => {
                    tracing::warn!("frame {} is left out: {error}", posed.0);
                    Ok(None)
                }
            };
            let written: Vec<Written> = batch.par_iter().zip(frames).zip(rectifiers).map(write).collect();
            for image in written {
                match image? {
                    Some(image) => images.push(image),
                    None => unreadable += 1,
                }
            }
            on_image(images.len());
        }
        Ok((images, unreadable))
    }

    fn image(&self, frame: &Frame, world_from_camera: Se3, rectifier: &Rectifier) -> Result<PosedImage, WriteError> {
        let rectified = rectifier.rectify(frame);
        let ending = self.recording.sequence().plain_image(frame.index).and_then(|path| {
            let ending = path.extension()?.to_str()?.to_ascii_lowercase();
            PLAIN.contains(&ending.as_str()).then_some((path, ending))
        });
        let name = format!("{:06}.{}", frame.index, ending.as_ref().map_or("png", |(_, ending)| ending));
        let color = self.out.join(IMAGES).join(&name);
        // A file that has vanished since it was decoded is encoded anew.
        let recorded = ending.and_then(|(path, _)| std::fs::read(path).ok());
        write_beside(&color, &recorded.unwrap_or_else(|| png(rectified.color.clone())))?;
        let (width, height) = rectified.color.dimensions();
        if let Some(valid) = &rectified.valid {
            let mask = GrayImage::from_fn(width, height, |x, y| Luma([if valid[(y * width + x) as usize] { 255 } else { 0 }]));
            write_beside(&self.out.join(MASKS).join(mask_name(&name)), &png(mask))?;
        }
        let depth = rectified.depth.as_ref().filter(|_| self.has_depth);
        if let Some(DepthImage { width, height, metres }) = depth {
            // What a 16-bit image cannot hold counts as not measured.
            let millimetres = |metres: &f32| u16::try_from((metres * MILLIMETRES).round() as u32).unwrap_or(0);
            let units: Vec<u16> = metres.iter().map(millimetres).collect();
            let image: ImageBuffer<Luma<u16>, Vec<u16>> = ImageBuffer::from_raw(*width, *height, units).expect("its own size");
            write_beside(&self.out.join(DEPTH).join(depth_name(&name)), &png(image))?;
        }
        let (has_mask, has_depth) = (rectified.valid.is_some(), depth.is_some());
        Ok(PosedImage { name, pinhole: rectified.pinhole, world_from_camera, has_mask, has_depth })
    }
}

/// Writes a file and the folder that it lies in.
fn write_beside(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder).map_err(|source| WriteError { path: folder.into(), source })?;
    write_atomically(path, bytes)
}

fn png(image: impl Into<image::DynamicImage>) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, ImageFormat::Png).expect("memory takes a PNG");
    bytes.into_inner()
}
