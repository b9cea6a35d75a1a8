//! A video's frames from its beginning, one after the other, with OpenCV.
//!
//! There is no seeking: what a decoder makes of the middle of a file depends on where it entered, and frames must be the same each time.

use std::path::Path;

use image::RgbImage;
use opencv::core::{CV_8UC3, Mat, MatTraitConst, MatTraitConstManual, Vector};
use opencv::videoio::{self, VideoCapture, VideoCaptureAPIs, VideoCaptureTrait, VideoCaptureTraitConst};

/// Attempts in a row that may fail before a video counts as ended: damaged frames in its middle are passed over.
const PATIENCE: usize = 30;
/// Containers say strange things where they do not know; no camera for us is faster.
const MAX_FPS: f64 = 1000.0;

/// An open video, at the frame that was decoded last.
#[derive(Debug)]
pub struct Decoder {
    capture: VideoCapture,
    decoded: usize,
}

impl Decoder {
    /// Before the first frame; `None` where there is no decoder for the file.
    pub fn open(path: &Path) -> opencv::Result<Option<Self>> {
        let mut capture = if videoio::has_backend(VideoCaptureAPIs::CAP_FFMPEG)? {
            // A hardware decoder may round otherwise than the next machine's.
            let plain = [videoio::CAP_PROP_HW_ACCELERATION, videoio::VIDEO_ACCELERATION_NONE];
            VideoCapture::from_file_with_params(path, videoio::CAP_FFMPEG, &Vector::from_slice(&plain))?
        } else {
            VideoCapture::from_file(path, videoio::CAP_ANY)?
        };
        if !capture.is_opened()? {
            return Ok(None);
        }
        // As it was filmed: OpenCV 4.6 turns the wrong way round (its issue 22088), 4.11 no longer by itself. Backends that know
        // nothing of turning refuse this, and do not turn.
        capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0)?;
        Ok(Some(Self { capture, decoded: 0 }))
    }

    /// Frames decoded so far.
    pub fn decoded(&self) -> usize {
        self.decoded
    }

    /// Decodes the next frame; whether there was one.
    pub fn advance(&mut self) -> opencv::Result<bool> {
        for _ in 0..PATIENCE {
            if self.capture.grab()? {
                self.decoded += 1;
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// When the frame decoded last is shown, seconds; has no meaning in some containers.
    pub fn time_s(&self) -> opencv::Result<f64> {
        Ok(self.capture.get(videoio::CAP_PROP_POS_MSEC)? / 1000.0)
    }

    /// The frame decoded last; `None` where it is none of 8-bit colour.
    pub fn picture(&mut self) -> opencv::Result<Option<RgbImage>> {
        let mut bgr = Mat::default();
        if !self.capture.retrieve(&mut bgr, 0)? || bgr.typ() != CV_8UC3 || !bgr.is_continuous() {
            return Ok(None);
        }
        let mut values = bgr.data_bytes()?.to_vec();
        values.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
        Ok(RgbImage::from_raw(bgr.cols().unsigned_abs(), bgr.rows().unsigned_abs(), values))
    }

    /// Frames per second as the container says, `None` where that is no rate.
    pub fn fps(&self) -> opencv::Result<Option<f64>> {
        Ok(Some(self.capture.get(videoio::CAP_PROP_FPS)?).filter(|fps| *fps > 0.0 && *fps <= MAX_FPS))
    }

    /// Frames in the video as the container says: an estimate in some, a lie in damaged ones; 0 where it doesn't say.
    pub fn claimed_frames(&self) -> opencv::Result<usize> {
        Ok(self.capture.get(videoio::CAP_PROP_FRAME_COUNT)?.max(0.0) as usize)
    }
}
