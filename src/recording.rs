//! A recording that has been opened with its resolved configuration: the input of every run, evaluation and benchmark.

use std::path::PathBuf;

use crate::config::{Config, ConfigError};
use crate::evaluation::image::WINDOW as SSIM_WINDOW;
use crate::evaluation::trajectory::MAX_TIME_DIFFERENCE_S;
use crate::geometry::{Pinhole, Se3};
use crate::sequence::{ASSUMED_CAMERA, Sensor, Sequence, SequenceError};

/// A selection of a sequence's frames and the configuration that maps them. Immutable: a change makes a new value.
#[derive(Clone, Debug)]
pub struct Recording {
    sequence: Sequence,
    config: Config,
}

/// A recording that cannot be opened, or cannot begin a map.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// `sequence` is absent from the configuration.
    #[error("the configuration names no recording; give its folder or video")]
    Unnamed,
    /// `sequence.camera` is `auto`.
    #[error(
        "sequence.camera is `auto`, which is no camera yet: find it by `keysplat calibrate` and name the camera.toml that it writes"
    )]
    Uncalibrated,
    /// A configuration value is out of its range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The dataset cannot be read.
    #[error(transparent)]
    Sequence(#[from] SequenceError),
    /// An RGB-D recording whose first frame has no depth image.
    #[error(
        "the first frame, {color}, has no depth image near its time; the map is started from depth: give the recording's depth (depth.txt), or begin at a frame that has one with --frames"
    )]
    NoFirstDepth {
        /// Colour image of the frame.
        color: PathBuf,
    },
    /// Frames of several cameras without `replay.known_poses`.
    #[error(
        "the photos of {name} have different cameras, and tracking needs one; take the recording's own poses with --known-poses, or select photos of one camera with --frames"
    )]
    SeveralCameras {
        /// Name of the recording.
        name: String,
    },
    /// `replay.known_poses` without a pose near any frame.
    #[error(
        "{name} has no pose within {seconds} s of any frame; known poses come from COLMAP's model, transforms.json or the recording's ground truth: leave --known-poses out to track instead"
    )]
    NoKnownPoses {
        /// Name of the recording.
        name: String,
        /// Largest difference of timestamps, seconds.
        seconds: f64,
    },
    /// Images below the SSIM window's size.
    #[error(
        "images would be mapped at {width}x{height}, but the least is {least}x{least}; raise the mapping resolution (--map-scale)"
    )]
    TooSmall {
        /// Mapping resolution, pixels.
        width: u32,
        /// Mapping resolution, pixels.
        height: u32,
        /// Least side, pixels.
        least: u32,
    },
}

impl Recording {
    /// Opens the recording that `config` names, with its sensor and its selection of frames. A range of frames that goes on beyond the
    /// recording ends with it.
    ///
    /// # Errors
    /// If the configuration names no recording, the dataset cannot be read, images are too small to be compared, or `replay.known_poses` is
    /// set and poses are missing.
    pub fn open(mut config: Config) -> Result<Self, RecordingError> {
        config.validate()?;
        let named = config.sequence.as_ref().ok_or(RecordingError::Unnamed)?;
        if named.camera.as_deref() == Some(ASSUMED_CAMERA) {
            return Err(RecordingError::Uncalibrated);
        }
        if named.path.is_file() {
            tracing::info!("decoding {} for the times of its frames", named.path.display());
        }
        let mut sequence = Sequence::open(&named.path, named.layout, named.camera.as_deref())?;
        if let Some(kind) = named.sensor {
            sequence.restrict_to(kind)?;
        }
        let recorded = sequence.entries.len();
        let range = config.replay.frames.map(|(start, end)| start..end);
        sequence.select(range, config.replay.every)?;
        config.replay.frames = config.replay.frames.map(|(start, end)| (start, end.min(recorded)));
        let recording = Self { sequence, config };
        recording.check_size()?;
        if recording.config.replay.known_poses && recording.config.refined.is_none() {
            recording.check_known_poses()?;
        }
        Ok(recording)
    }

    /// The same frames with another configuration, which must select these frames.
    ///
    /// # Errors
    /// If a value is out of its range, or images become too small to be compared.
    pub fn with_config(mut self, config: Config) -> Result<Self, RecordingError> {
        config.validate()?;
        // The selection's end is the recording's.
        let frames = self.config.replay.frames;
        self.config = config;
        self.config.replay.frames = frames;
        self.check_size()?;
        Ok(self)
    }

    /// The frames and their camera.
    pub fn sequence(&self) -> &Sequence {
        &self.sequence
    }

    /// The resolved configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Intrinsics at the mapping resolution, without distortion; the first frame's, where photos have several.
    pub fn map_pinhole(&self) -> Pinhole {
        self.sequence.camera.pinhole.scaled(self.config.map_scale)
    }

    /// The same of frame `index`.
    pub fn map_pinhole_of(&self, index: usize) -> Pinhole {
        self.sequence.camera_of(index).pinhole.scaled(self.config.map_scale)
    }

    /// The recording's own `world_from_camera` at a time in seconds, if one is near.
    pub fn known_pose(&self, timestamp_s: f64) -> Option<Se3> {
        let truth = self.sequence.groundtruth.as_ref()?;
        truth.nearest(timestamp_s, MAX_TIME_DIFFERENCE_S).map(|i| truth.poses[i].world_from_camera)
    }

    /// Checks that tracking can begin a map at the first frame.
    ///
    /// # Errors
    /// If frames have different cameras, or the sensor is RGB-D and the first frame has no depth.
    pub fn check_trackable(&self) -> Result<(), RecordingError> {
        if !self.sequence.has_one_camera() {
            return Err(RecordingError::SeveralCameras { name: self.sequence.name.clone() });
        }
        match self.sequence.entries.first() {
            Some(first) if self.sequence.sensor == Sensor::Rgbd && first.depth.is_none() => {
                Err(RecordingError::NoFirstDepth { color: first.color.clone() })
            }
            _ => Ok(()),
        }
    }

    fn check_size(&self) -> Result<(), RecordingError> {
        let least = SSIM_WINDOW as u32;
        let pinholes = (0..self.sequence.entries.len()).map(|index| self.map_pinhole_of(index));
        let mut pinholes = pinholes;
        let too_small = pinholes.find(|Pinhole { width, height, .. }| *width.min(height) < least);
        too_small.map_or(Ok(()), |Pinhole { width, height, .. }| Err(RecordingError::TooSmall { width, height, least }))
    }

    fn check_known_poses(&self) -> Result<(), RecordingError> {
        if self.sequence.entries.iter().any(|entry| self.known_pose(entry.timestamp_s).is_some()) {
            return Ok(());
        }
        Err(RecordingError::NoKnownPoses { name: self.sequence.name.clone(), seconds: MAX_TIME_DIFFERENCE_S })
    }
}
