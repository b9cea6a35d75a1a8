//! A video, taken by one camera: the file itself, or a folder with a `camera.toml` and nothing but one video to look at.
//!
//! The camera is `camera.toml` beside the video, as a plain folder of images has it (`images`), unless another one is named. Its numbers
//! are those of the picture as it was filmed: a video that says how players shall turn it is not turned.
//!
//! Opening decodes the video once, for the times of its frames: containers count wrongly, phones film at no steady rate, and `decoder`
//! never seeks. Frames then come in order at the cost of decoding; going back begins at the first frame again.

pub(super) mod container;
mod decoder;
#[cfg(test)]
mod tests;

use std::cell::Cell;
use std::fs::File;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use image::RgbImage;

use super::images;
use super::row::LayoutRow;
use crate::geometry::Camera;
use crate::sequence::{FrameEntry, Sensor, Sequence, SequenceError, cameras, files_in, images_in, read_text};
use container::Container;
use decoder::Decoder;

const EXTENSIONS: [&str; 7] = ["mp4", "m4v", "mov", "3gp", "avi", "mkv", "webm"];
/// Nine hours at 30 Hz. A cut file's header that claims more frames is damaged itself.
const MOST_MISSING: usize = 1_000_000;
/// Frames that a decoder holds back: 16 to put them in order (H.264), and one for each of its threads.
const MOST_DELAYED: usize = 32;

/// The layout's row in [`super::LAYOUTS`].
pub(super) const LAYOUT: LayoutRow = LayoutRow {
    name: "video",
    marker: "camera.toml and a video",
    help: "A video file with its `camera.toml` beside it, or a folder with these two alone.",
    is_photos: false,
    takes_camera: true,
    recognise,
    open,
    parse: |bytes| {
        let io = |source| SequenceError::Read { path: Path::new("file").into(), source };
        let is_cut = |container: Container| container.is_cut(Cursor::new(bytes)).map_err(io);
        let container = Container::of(bytes).map_err(io).map(|container| container.map(is_cut));
        vec![container.and_then(|is_cut| is_cut.transpose().map(drop))]
    },
};

/// Whether a folder holds a video and its camera, and no images that would be taken first.
fn recognise(folder: &Path) -> bool {
    let has_images = ["rgb", "left"].iter().any(|name| folder.join(name).is_dir());
    let some = |files: Result<Vec<PathBuf>, _>| files.is_ok_and(|files| !files.is_empty());
    images::recognise(folder) && !has_images && !some(images_in(folder)) && some(files_in(folder, &EXTENSIONS))
}

/// Opens a video or the folder that holds one. `camera` names a preset or another `camera.toml`.
fn open(path: &Path, camera: Option<&str>) -> Result<Sequence, SequenceError> {
    let path = if path.is_dir() { only_video_in(path)? } else { path.into() };
    let read_error = |source| SequenceError::Read { path: path.clone(), source };
    let mut file = File::open(&path).map_err(read_error)?;
    let container = Container::of(&file).map_err(read_error)?.ok_or_else(|| SequenceError::NoVideo { path: path.clone() })?;
    let is_assumed = camera == Some(cameras::ASSUMED);
    let (mut camera, usual_fps) =
        if is_assumed { (Camera::assumed(1, 1), images::usual_fps()) } else { camera_of(&path, camera)? };
    let name = path.file_stem().map_or_else(|| "video".into(), |stem| stem.to_string_lossy().into_owned());
    let is_cut = container.is_cut(&mut file).map_err(read_error)?;
    let filmed = Cell::new((1, 1));
    let check_size = |(width, height)| {
        filmed.set((width, height));
        if is_assumed {
            return Ok(());
        }
        if (height, width) == (camera.pinhole.width, camera.pinhole.height) && width != height {
            let what = format!("was filmed as {width}x{height}, whichever way players turn it; calibrate the camera for that");
            return Err(SequenceError::Content { path: path.clone(), what });
        }
        crate::sequence::check_size(&camera, &path, (width, height))
    };
    let video = Video::scan(&path, is_cut, usual_fps, &check_size)?;
    if is_assumed {
        camera = Camera::assumed(filmed.get().0, filmed.get().1);
    }
    let mut sequence = Sequence::new(name, &LAYOUT, camera, Sensor::Mono, Vec::new());
    let entry = |&timestamp_s| FrameEntry { timestamp_s, color: path.clone(), ..FrameEntry::default() };
    sequence.entries = video.times_s.iter().map(entry).collect();
    sequence.video = Some(Arc::new(video));
    Ok(sequence)
}

fn only_video_in(folder: &Path) -> Result<PathBuf, SequenceError> {
    let content = |what: &str| SequenceError::Content { path: folder.into(), what: what.into() };
    let mut videos = files_in(folder, &EXTENSIONS)?;
    match (videos.pop(), videos.pop()) {
        (Some(video), None) => Ok(video),
        (None, _) => Err(content("there is no video in this folder; name the file itself")),
        (Some(_), Some(_)) => Err(content("there are several videos in this folder; name one of the files")),
    }
}

/// The camera of a video, and the frame rate to fall back on.
fn camera_of(video: &Path, named: Option<&str>) -> Result<(Camera, f64), SequenceError> {
    let path = match named {
        Some(name) if !cameras::is_file(name) => return Ok((cameras::by_name(name)?, images::usual_fps())),
        Some(file) => file.into(),
        None => video.with_file_name(images::FILE),
    };
    if named.is_none() && !path.is_file() {
        let what = "there is no camera.toml beside this video; write one with fps and pinhole, name one with --camera, or let it be found with --camera auto";
        return Err(SequenceError::Content { path: video.into(), what: what.into() });
    }
    let (camera, file) = images::parse_camera(&read_text(&path)?, &path)?;
    if file.stereo.is_some() {
        let what = "a video is of one camera: remove [stereo], or make folders left and right of its frames";
        return Err(SequenceError::Content { path, what: what.into() });
    }
    Ok((camera, file.fps))
}

/// A video whose frames are known by their times.
#[derive(Debug)]
pub(in crate::sequence) struct Video {
    path: PathBuf,
    /// Time of each frame since the first, strictly increasing.
    times_s: Vec<f64>,
    /// So many of them were decoded when the video was opened; the others its container counts, but the file ends before them.
    decodable: usize,
    decoder: Mutex<Option<Decoder>>,
}

impl Video {
    /// Decodes all of a video once. `check_size` sees the size of the first frame before the others are decoded.
    fn scan(
        path: &Path,
        is_cut: bool,
        usual_fps: f64,
        check_size: &dyn Fn((u32, u32)) -> Result<(), SequenceError>,
    ) -> Result<Self, SequenceError> {
        let failed = |error: opencv::Error| decoder_failed(path, &error);
        let mut decoder = open_decoder(path, is_cut)?;
        let (mut stamps_s, mut sized) = (Vec::new(), false);
        while decoder.advance().map_err(failed)? {
            stamps_s.push(decoder.time_s().map_err(failed)?);
            if !sized && let Some(picture) = decoder.picture().map_err(failed)? {
                check_size(picture.dimensions())?;
                sized = true;
            }
        }
        if !sized {
            return Err(undecodable(path, is_cut));
        }
        let decodable = stamps_s.len();
        let claimed = if is_cut { decoder.claimed_frames().map_err(failed)? } else { 0 };
        let missing = Some(claimed.saturating_sub(decodable)).filter(|missing| *missing <= MOST_MISSING).unwrap_or_default();
        let fps = decoder.fps().map_err(failed)?.unwrap_or(usual_fps);
        Ok(Self { path: path.into(), times_s: times(&stamps_s, missing, fps), decodable, decoder: Mutex::new(None) })
    }

    /// The frame that is shown at `time_s`, one of this video's times.
    pub(in crate::sequence) fn load(&self, time_s: f64) -> Result<RgbImage, SequenceError> {
        let failed = |error: opencv::Error| decoder_failed(&self.path, &error);
        let index = self.times_s.partition_point(|t| *t < time_s);
        let unreadable = || SequenceError::VideoFrame { path: self.path.clone(), frame: index };
        if index >= self.decodable {
            return Err(unreadable());
        }
        // A thread that panicked here left at worst a decoder that is at another frame than the next caller wants.
        let mut guard = self.decoder.lock().unwrap_or_else(PoisonError::into_inner);
        let mut decoder = match guard.take().filter(|decoder| decoder.decoded() <= index + 1) {
            Some(decoder) => decoder,
            None => open_decoder(&self.path, false)?,
        };
        while decoder.decoded() <= index {
            if !decoder.advance().map_err(failed)? {
                return Err(unreadable());
            }
        }
        let picture = decoder.picture().map_err(failed)?;
        *guard = Some(decoder);
        picture.ok_or_else(unreadable)
    }
}

/// When each frame is shown, since the first: as the container says while its times increase. Those behind, few where a decoder gives
/// its last frames without their times, and `missing` more follow at a steady rate; where they are many, all do.
fn times(stamps_s: &[f64], missing: usize, fps: f64) -> Vec<f64> {
    let mut times: Vec<f64> = Vec::with_capacity(stamps_s.len() + missing);
    for time_s in stamps_s.iter().map(|stamp| stamp - stamps_s[0]) {
        if !time_s.is_finite() || times.last().is_some_and(|last| time_s <= *last) {
            break;
        }
        times.push(time_s);
    }
    if stamps_s.len() - times.len() > MOST_DELAYED {
        times.clear();
    }
    let (good, last_s) = (times.len(), times.last().copied().unwrap_or(-1.0 / fps));
    times.extend((1..=stamps_s.len() - good + missing).map(|k| last_s + k as f64 / fps));
    times
}

fn open_decoder(path: &Path, is_cut: bool) -> Result<Decoder, SequenceError> {
    // Absolute, so that no name is taken for a protocol or a device.
    let absolute = std::path::absolute(path).map_err(|source| SequenceError::Read { path: path.into(), source })?;
    let decoder = Decoder::open(&absolute).map_err(|error| decoder_failed(path, &error))?;
    decoder.ok_or_else(|| undecodable(path, is_cut))
}

fn undecodable(path: &Path, is_cut: bool) -> SequenceError {
    let what = if is_cut {
        "no frame can be decoded, the file ends too early; copy it whole"
    } else {
        "no frame can be decoded; play it to see whether it is damaged, or convert it to H.264 or Motion JPEG"
    };
    SequenceError::Content { path: path.into(), what: what.into() }
}

fn decoder_failed(path: &Path, error: &opencv::Error) -> SequenceError {
    SequenceError::Content { path: path.into(), what: format!("OpenCV cannot decode it: {}", error.message) }
}
