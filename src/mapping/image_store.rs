//! Images of keyframes beyond those on the GPU: in memory up to a bound, then in an unnamed temporary file.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};

use crate::optimise::Pixels;

/// Where offloaded images are.
#[derive(Debug)]
pub(super) struct ImageStore {
    max_bytes: u64,
    bytes: u64,
    /// Made once the memory is used up. Its place has no name, so it goes with the process.
    file: Option<File>,
    file_bytes: u64,
}

/// One offloaded image.
#[derive(Debug)]
pub(super) enum StoredImage {
    InMemory(Pixels),
    /// Colours, then depths, from this byte on.
    InFile {
        at: u64,
        pixels: usize,
    },
}

impl ImageStore {
    /// An empty store that holds at most `max_bytes` in memory.
    pub fn new(max_bytes: u64) -> Self {
        Self { max_bytes, bytes: 0, file: None, file_bytes: 0 }
    }

    /// Takes an image in. Where the temporary folder is full it stays in memory, beyond the bound.
    pub fn put(&mut self, pixels: Pixels) -> StoredImage {
        let bytes = 8 * pixels.color.len() as u64;
        if self.bytes + bytes > self.max_bytes {
            match self.write(&pixels) {
                Ok(stored) => return stored,
                Err(error) => tracing::warn!(
                    %error,
                    folder = %std::env::temp_dir().display(),
                    "cannot write a keyframe's image to the temporary folder; it stays in memory, beyond --max-host-memory. Free some \
                     space, or set TMPDIR"
                ),
            }
        }
        self.bytes += bytes;
        StoredImage::InMemory(pixels)
    }

    fn write(&mut self, pixels: &Pixels) -> io::Result<StoredImage> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile()?),
        };
        let at = self.file_bytes;
        file.seek(SeekFrom::Start(at))?;
        file.write_all(bytemuck::cast_slice(&pixels.color))?;
        file.write_all(bytemuck::cast_slice(&pixels.depth_metres))?;
        self.file_bytes += 8 * pixels.color.len() as u64;
        Ok(StoredImage::InFile { at, pixels: pixels.color.len() })
    }

    /// An image again.
    ///
    /// # Errors
    /// If the temporary file cannot be read.
    pub fn get<'a>(&self, stored: &'a StoredImage) -> io::Result<Cow<'a, Pixels>> {
        match stored {
            StoredImage::InMemory(pixels) => Ok(Cow::Borrowed(pixels)),
            StoredImage::InFile { at, pixels } => {
                let mut file = self.file.as_ref().ok_or(io::ErrorKind::NotFound)?;
                let mut read = Pixels { color: vec![0; *pixels], depth_metres: vec![0.0; *pixels] };
                file.seek(SeekFrom::Start(*at))?;
                file.read_exact(bytemuck::cast_slice_mut(&mut read.color))?;
                file.read_exact(bytemuck::cast_slice_mut(&mut read.depth_metres))?;
                Ok(Cow::Owned(read))
            }
        }
    }

    /// Replaces the depths of a stored image, metres.
    ///
    /// # Errors
    /// If the temporary file cannot be written.
    pub fn set_depth(&self, stored: &mut StoredImage, metres: &[f32]) -> io::Result<()> {
        match stored {
            StoredImage::InMemory(pixels) => pixels.depth_metres.copy_from_slice(metres),
            StoredImage::InFile { at, pixels } => {
                let mut file = self.file.as_ref().ok_or(io::ErrorKind::NotFound)?;
                file.seek(SeekFrom::Start(*at + 4 * *pixels as u64))?;
                file.write_all(bytemuck::cast_slice(metres))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_come_back_from_memory_and_from_the_file() {
        let image = |seed: u32| Pixels { color: (seed..seed + 6).collect(), depth_metres: vec![seed as f32 + 0.5; 6] };
        // Room for two of five, 48 bytes each.
        let mut store = ImageStore::new(100);
        let mut stored: Vec<StoredImage> = (0..5).map(|seed| store.put(image(seed))).collect();
        assert_eq!(stored.iter().filter(|stored| matches!(stored, StoredImage::InMemory(_))).count(), 2);
        for k in [4, 0, 2, 3, 1, 2] {
            assert_eq!(*store.get(&stored[k]).unwrap(), image(k as u32));
        }
        [1, 3].into_iter().for_each(|k| store.set_depth(&mut stored[k], &[7.0; 6]).unwrap());
        for k in 0..5 {
            let depth_metres = if k == 1 || k == 3 { vec![7.0; 6] } else { image(k).depth_metres };
            assert_eq!(*store.get(&stored[k as usize]).unwrap(), Pixels { depth_metres, ..image(k) });
        }
    }
}
