//! Files of a moving picture: MP4 by OpenCV, GIF, or numbered PNG pictures. The file appears under its name when it is whole.

use std::path::{Path, PathBuf};

use gif::{Encoder, Frame, Repeat};
use image::{DynamicImage, RgbImage};
use opencv::core::{CV_8UC3, Mat, MatTraitManual, Size};
use opencv::videoio::{VideoWriter, VideoWriterTrait, VideoWriterTraitConst};

use crate::files::{WriteError, write_atomically};

/// Quality and speed of a GIF's palettes, 1 (best) to 30.
const PALETTE_SPEED: i32 = 10;
/// Codecs of MP4 files, the one that browsers play first.
const CODECS: [[char; 4]; 2] = [['a', 'v', 'c', '1'], ['m', 'p', '4', 'v']];

/// A moving picture that cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// An ending that is no format.
    #[error("{path} ends in no known format; choose .mp4, .gif or .png")]
    Format {
        /// The path.
        path: PathBuf,
    },
    /// OpenCV has no encoder.
    #[error(
        "{path} cannot be written as a video here: OpenCV has no encoder for it, or the folder cannot be written to; choose .gif or .png"
    )]
    NoEncoder {
        /// The path.
        path: PathBuf,
    },
    /// OpenCV failed.
    #[error("{path}: {source}")]
    Video {
        /// The path.
        path: PathBuf,
        /// The cause.
        source: opencv::Error,
    },
    /// A picture cannot be encoded.
    #[error("{path}: {reason}")]
    Picture {
        /// The path.
        path: PathBuf,
        /// The cause.
        reason: String,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The video cannot get its name.
    #[error("cannot write {path}: {source}")]
    Rename {
        /// The path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
}

/// A file that is not whole; removed unless it gets its name.
struct Partial(PathBuf);

impl Drop for Partial {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A moving picture that is being written.
pub struct Film {
    path: PathBuf,
    form: Form,
}

enum Form {
    Video { writer: VideoWriter, partial: Partial },
    Gif { encoder: Encoder<Vec<u8>>, delay: u16 },
    Pictures { count: usize },
}

impl Film {
    /// Begins a file, whose ending says how; frames have one size, even along both sides.
    ///
    /// # Errors
    /// [`FilmError`] if the ending is unknown, or no encoder is there.
    pub fn create(path: &Path, (width, height): (u32, u32), fps: f64) -> Result<Self, FilmError> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
        let form = match ending.as_str() {
            "mp4" => video(path, (width, height), fps)?,
            "gif" => gif(path, (width, height), fps)?,
            "png" => Form::Pictures { count: 0 },
            _ => return Err(FilmError::Format { path: path.into() }),
        };
        Ok(Self { path: path.into(), form })
    }

    /// Appends a frame.
    ///
    /// # Errors
    /// [`FilmError`] if it cannot be encoded or written.
    pub fn append(&mut self, frame: &RgbImage) -> Result<(), FilmError> {
        let path = &self.path;
        match &mut self.form {
            Form::Video { writer, .. } => {
                let mat = bgr(frame).map_err(|source| FilmError::Video { path: path.clone(), source })?;
                writer.write(&mat).map_err(|source| FilmError::Video { path: path.clone(), source })
            }
            Form::Gif { encoder, delay } => {
                let (width, height) = (frame.width() as u16, frame.height() as u16);
                let mut picture = Frame::from_rgb_speed(width, height, frame.as_raw(), PALETTE_SPEED);
                picture.delay = *delay;
                encoder.write_frame(&picture).map_err(|e| FilmError::Picture { path: path.clone(), reason: e.to_string() })
            }
            Form::Pictures { count } => {
                *count += 1;
                let mut bytes = std::io::Cursor::new(Vec::new());
                let png = DynamicImage::from(frame.clone()).write_to(&mut bytes, image::ImageFormat::Png);
                png.map_err(|e| FilmError::Picture { path: path.clone(), reason: e.to_string() })?;
                Ok(write_atomically(&numbered(path, *count), bytes.get_ref())?)
            }
        }
    }

    /// Completes the file.
    ///
    /// # Errors
    /// [`FilmError`] if it cannot be written.
    pub fn finish(self) -> Result<(), FilmError> {
        let Self { path, form } = self;
        match form {
            Form::Video { mut writer, partial } => {
                writer.release().map_err(|source| FilmError::Video { path: path.clone(), source })?;
                std::fs::rename(&partial.0, &path).map_err(|source| FilmError::Rename { path, source })
            }
            Form::Gif { encoder, .. } => {
                let bytes = encoder.into_inner().map_err(|e| FilmError::Picture { path: path.clone(), reason: e.to_string() })?;
                Ok(write_atomically(&path, &bytes)?)
            }
            Form::Pictures { .. } => Ok(()),
        }
    }
}

/// `x.png` becomes `x-0001.png`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}-{number:04}.png"))
}

fn video(path: &Path, (width, height): (u32, u32), fps: f64) -> Result<Form, FilmError> {
    let error = |source| FilmError::Video { path: path.into(), source };
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let partial = Partial(path.with_file_name(format!(".partial-{name}")));
    let size = Size::new(width as i32, height as i32);
    for [a, b, c, d] in CODECS {
        let codec = VideoWriter::fourcc(a, b, c, d).map_err(error)?;
        let writer = VideoWriter::new(&partial.0, codec, fps, size, true).map_err(error)?;
        if writer.is_opened().map_err(error)? {
            return Ok(Form::Video { writer, partial });
        }
    }
    Err(FilmError::NoEncoder { path: path.into() })
}

fn gif(path: &Path, (width, height): (u32, u32), fps: f64) -> Result<Form, FilmError> {
    let error = |e: gif::EncodingError| FilmError::Picture { path: path.into(), reason: e.to_string() };
    let mut encoder = Encoder::new(Vec::new(), width as u16, height as u16, &[]).map_err(error)?;
    encoder.set_repeat(Repeat::Infinite).map_err(error)?;
    Ok(Form::Gif { encoder, delay: (100.0 / fps).round().max(2.0) as u16 })
}

fn bgr(frame: &RgbImage) -> opencv::Result<Mat> {
    // SAFETY: every byte is written below.
    let mut mat = unsafe { Mat::new_rows_cols(frame.height() as i32, frame.width() as i32, CV_8UC3) }?;
    let pixels = frame.as_raw().chunks_exact(3);
    mat.data_bytes_mut()?.chunks_exact_mut(3).zip(pixels).for_each(|(to, from)| to.copy_from_slice(&[from[2], from[1], from[0]]));
    Ok(mat)
}
