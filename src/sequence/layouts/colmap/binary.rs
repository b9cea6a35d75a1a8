//! COLMAP's binary models: little-endian records behind a count.
//!
//! Read in order, never whole: observations and tracks are skipped. A count is accepted only if its records fit into what is left of
//! the file, so that a damaged header allocates nothing.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use super::{KnownImage, MODELS, ModelCamera};
use crate::sequence::{KnownPoint, SequenceError, checks};

/// The longest name of an image that we read, bytes.
const LONGEST_NAME: usize = 4096;
/// Bytes of a record without its lists: numbers and model, size; a name of at least its end; colour, error and track's length.
const LEAST_CAMERA: u64 = 4 + 4 + 8 + 8;
const LEAST_IMAGE: u64 = 4 + 7 * 8 + 4 + 1 + 8;
const LEAST_POINT: u64 = 8 + 3 * 8 + 3 + 8 + 8;
/// Bytes of one observation (pixel, point) and of one track element (image, observation).
const OBSERVATION: u64 = 2 * 8 + 8;
const TRACK_ELEMENT: u64 = 4 + 4;

pub fn cameras(mut file: Records<impl Read + Seek>) -> Result<Vec<ModelCamera>, SequenceError> {
    let count = file.count(LEAST_CAMERA)?;
    let mut cameras = Vec::with_capacity(count);
    for _ in 0..count {
        let (id, model) = (file.u32()?, file.u32()?);
        let (width, height) = (file.u64()?, file.u64()?);
        let known = usize::try_from(model).ok().and_then(|model| MODELS.get(model));
        let (model, parameters) = *known.ok_or_else(|| file.wrong(&format!("there is no camera model {model}")))?;
        let parameters = (0..parameters).map(|_| file.f64()).collect::<Result<_, _>>()?;
        cameras.push(ModelCamera { id, model: model.into(), width, height, parameters });
    }
    Ok(cameras)
}

pub fn images(mut file: Records<impl Read + Seek>) -> Result<Vec<KnownImage>, SequenceError> {
    let count = file.count(LEAST_IMAGE)?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        let _id = file.u32()?;
        let quaternion = file.numbers()?;
        let translation = file.numbers()?;
        let camera = file.u32()?;
        let name = file.name()?;
        let observations = file.count(OBSERVATION)? as u64;
        file.skip(observations * OBSERVATION)?;
        let camera_from_world = checks::rigid_of_quaternion(translation, quaternion)
            .map_err(|what| SequenceError::Content { path: file.path.clone(), what: format!("{name}: {what}") })?;
        images.push(KnownImage { name, camera, camera_from_world });
    }
    Ok(images)
}

pub fn points(mut file: Records<impl Read + Seek>) -> Result<Vec<KnownPoint>, SequenceError> {
    let count = file.count(LEAST_POINT)?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        let _id = file.u64()?;
        let position: [f64; 3] = file.numbers()?;
        let color = file.take()?;
        let _error_pixels = file.f64()?;
        let track = file.count(TRACK_ELEMENT)? as u64;
        file.skip(track * TRACK_ELEMENT)?;
        if position.iter().any(|v| !v.is_finite()) {
            return Err(file.wrong("a point's position is not finite"));
        }
        points.push(KnownPoint { position: position.into(), color });
    }
    Ok(points)
}

/// A file that knows how many bytes are left of it.
pub struct Records<R> {
    path: PathBuf,
    reader: BufReader<R>,
    left: u64,
}

impl Records<File> {
    pub fn open(path: &Path) -> Result<Self, SequenceError> {
        let read_error = |source| SequenceError::Read { path: path.into(), source };
        let file = File::open(path).map_err(read_error)?;
        let left = file.metadata().map_err(read_error)?.len();
        Ok(Self::new(file, left, path))
    }
}

impl<R: Read + Seek> Records<R> {
    /// Reads at most `left` bytes; `path` is named in errors.
    pub fn new(reader: R, left: u64, path: &Path) -> Self {
        Self { path: path.into(), reader: BufReader::new(reader), left }
    }

    fn wrong(&self, what: &str) -> SequenceError {
        let what = format!("{what}, {} bytes before the end; the file is damaged, copy or export the model anew", self.left);
        SequenceError::Content { path: self.path.clone(), what }
    }

    /// Counts `bytes` as read, if there are so many.
    fn spend(&mut self, bytes: u64) -> Result<(), SequenceError> {
        self.left = self.left.checked_sub(bytes).ok_or_else(|| self.wrong("a record is cut off"))?;
        Ok(())
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], SequenceError> {
        self.spend(N as u64)?;
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes).map_err(|source| SequenceError::Read { path: self.path.clone(), source })?;
        Ok(bytes)
    }

    fn skip(&mut self, bytes: u64) -> Result<(), SequenceError> {
        self.spend(bytes)?;
        // A file's length fits.
        self.reader.seek_relative(bytes as i64).map_err(|source| SequenceError::Read { path: self.path.clone(), source })
    }

    fn u32(&mut self) -> Result<u32, SequenceError> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, SequenceError> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, SequenceError> {
        self.take().map(f64::from_le_bytes)
    }

    fn numbers<const N: usize>(&mut self) -> Result<[f64; N], SequenceError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Ok(numbers)
    }

    /// A count of records that take at least `bytes_each`.
    fn count(&mut self, bytes_each: u64) -> Result<usize, SequenceError> {
        let count = self.u64()?;
        if count > self.left / bytes_each {
            return Err(self.wrong(&format!("{count} records cannot fit")));
        }
        Ok(count as usize)
    }

    /// Text up to a zero byte.
    fn name(&mut self) -> Result<String, SequenceError> {
        let mut name = Vec::new();
        loop {
            match self.take::<1>()? {
                [0] => break,
                [byte] if name.len() < LONGEST_NAME => name.push(byte),
                _ => return Err(self.wrong("an image's name does not end")),
            }
        }
        String::from_utf8(name).map_err(|_| self.wrong("an image's name is no UTF-8"))
    }
}
