//! One file with all chunks that have left the GPU. A place in it is written once, and used again when its content is of no use any more.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::Members;
use crate::mapping::{KeyframeId, MappingError};
use crate::render::CloudPart;
use crate::splat::ShDegree;

/// A keyframe's number in the file.
const ID_BYTES: usize = size_of::<u64>();

/// Where a chunk's content is.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Stored {
    /// Bytes in the file; none where the disk was full.
    place: Range<u64>,
    /// The content itself then.
    in_memory: Vec<u8>,
    digest: [u8; 32],
}

/// The file and its free places.
#[derive(Debug)]
pub(super) struct Store {
    path: Option<PathBuf>,
    /// Made with the first chunk.
    file: Option<File>,
    end: u64,
    /// Free bytes before the end, by their first: neighbours are joined.
    free: BTreeMap<u64, u64>,
    has_failed: bool,
}

impl Store {
    /// Nothing yet. An earlier run's file is removed.
    pub fn begin(path: Option<PathBuf>) -> Self {
        path.iter().for_each(|path| drop(std::fs::remove_file(path)));
        Self { path, file: None, end: 0, free: BTreeMap::new(), has_failed: false }
    }

    /// The file as a checkpoint names it: all else in it is free.
    pub fn restore<'a>(path: Option<PathBuf>, stored: impl Iterator<Item = &'a Stored>) -> Result<Self, MappingError> {
        let mut places: Vec<Range<u64>> = stored.map(|stored| stored.place.clone()).filter(|place| !place.is_empty()).collect();
        places.sort_unstable_by_key(|place| place.start);
        if places.is_empty() {
            return Ok(Self::begin(path));
        }
        let mut store = Self { path, file: None, end: 0, free: BTreeMap::new(), has_failed: false };
        for place in places {
            if place.start > store.end {
                store.free.insert(store.end, place.start - store.end);
            }
            store.end = store.end.max(place.end);
        }
        let named = store.path.clone().ok_or(MappingError::State)?;
        let opened = File::options().read(true).write(true).open(named);
        let file = opened.map_err(|source| store.error(format!("cannot be opened: {source}")))?;
        if file.metadata().map_or(0, |file| file.len()) < store.end {
            return Err(store.error("is cut off".into()));
        }
        store.file = Some(file);
        Ok(store)
    }

    fn error(&self, reason: String) -> MappingError {
        MappingError::Chunks { path: self.path.clone().unwrap_or_else(std::env::temp_dir), reason }
    }

    /// Writes a chunk. Where the disk is full it stays in memory.
    pub fn put(&mut self, members: &Members) -> Stored {
        let mut bytes = members.part.to_bytes();
        bytes.extend(members.keyframes.iter().flat_map(|keyframe| (*keyframe as u64).to_ne_bytes()));
        let digest = Sha256::digest(&bytes).into();
        let place = self.take(bytes.len() as u64);
        let (place, in_memory) = match self.write(place.start, &bytes) {
            Ok(()) => (place, Vec::new()),
            Err(error) => {
                if !std::mem::replace(&mut self.has_failed, true) {
                    let file = self.path.clone().unwrap_or_else(std::env::temp_dir).display().to_string();
                    tracing::warn!(%error, file, "cannot write Gaussians that leave the GPU; they stay in memory. Free some space");
                }
                self.free(place);
                (0..0, bytes)
            }
        };
        Stored { place, in_memory, digest }
    }

    fn write(&mut self, at: u64, bytes: &[u8]) -> io::Result<()> {
        let file = match (&mut self.file, &self.path) {
            (Some(file), _) => file,
            (none, Some(path)) => none.insert(File::options().read(true).write(true).create(true).truncate(true).open(path)?),
            (none, None) => none.insert(tempfile::tempfile()?),
        };
        file.seek(SeekFrom::Start(at))?;
        file.write_all(bytes)
    }

    /// Reads a chunk of so many Gaussians.
    pub fn get(&self, stored: &Stored, gaussians: usize, sh_degree: ShDegree) -> Result<Members, MappingError> {
        let mut bytes = stored.in_memory.clone();
        if !stored.place.is_empty() {
            bytes.resize((stored.place.end - stored.place.start) as usize, 0);
            let read = self.read(stored.place.start, &mut bytes);
            read.map_err(|source| self.error(format!("cannot be read: {source}")))?;
        }
        let is_same = Sha256::digest(&bytes).as_slice() == stored.digest;
        let read = bytes.split_at_checked(bytes.len().saturating_sub(gaussians * ID_BYTES)).filter(|_| is_same);
        let part = read.and_then(|(part, ids)| Some((CloudPart::from_bytes(part, sh_degree, gaussians)?, ids)));
        let (part, ids) = part.ok_or_else(|| self.error("has changed since it was written".into()))?;
        let id = |bytes: &[u8]| u64::from_ne_bytes(bytes.try_into().expect("chunks of eight bytes")) as KeyframeId;
        Ok(Members { part, keyframes: ids.chunks_exact(ID_BYTES).map(id).collect() })
    }

    fn read(&self, at: u64, bytes: &mut [u8]) -> io::Result<()> {
        let mut file = self.file.as_ref().ok_or(io::ErrorKind::NotFound)?;
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(bytes)
    }

    /// A chunk's content is of no use any more.
    pub fn give_back(&mut self, stored: &Stored) {
        self.free(stored.place.clone());
    }

    /// Flushes all to the disk.
    pub fn flush(&self) -> Result<(), MappingError> {
        let flushed = self.file.as_ref().map_or(Ok(()), File::sync_data);
        flushed.map_err(|source| self.error(format!("cannot be flushed to the disk: {source}")))
    }

    /// The first free place of so many bytes.
    fn take(&mut self, bytes: u64) -> Range<u64> {
        let Some((at, free)) = self.free.iter().find(|(_, free)| **free >= bytes).map(|(at, free)| (*at, *free)) else {
            self.end += bytes;
            return self.end - bytes..self.end;
        };
        self.free.remove(&at);
        if free > bytes {
            self.free.insert(at + bytes, free - bytes);
        }
        at..at + bytes
    }

    fn free(&mut self, place: Range<u64>) {
        if place.is_empty() {
            return;
        }
        let (mut at, mut end) = (place.start, place.end);
        if let Some((before, free)) = self.free.range(..at).next_back().map(|(before, free)| (*before, *free))
            && before + free == at
        {
            at = before;
        }
        end += self.free.remove(&end).unwrap_or(0);
        if end == self.end {
            self.free.remove(&at);
            self.end = at;
        } else {
            self.free.insert(at, end - at);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Places never overlap, and what is given back is used again.
        #[test]
        fn every_place_belongs_to_one(actions in prop::collection::vec((any::<prop::sample::Index>(), 1u64..40, any::<bool>()), 1..200)) {
            let mut store = Store::begin(None);
            let mut taken: Vec<Range<u64>> = Vec::new();
            for (which, bytes, gives_back) in actions {
                if gives_back && !taken.is_empty() {
                    let place = taken.swap_remove(which.index(taken.len()));
                    store.free(place);
                } else {
                    taken.push(store.take(bytes));
                }
                let mut all: Vec<Range<u64>> = taken.iter().cloned().chain(store.free.iter().map(|(at, free)| *at..at + free)).collect();
                all.sort_by_key(|place| place.start);
                prop_assert_eq!(all.first().map_or(0, |place| place.start), 0);
                prop_assert!(all.windows(2).all(|pair| pair[0].end == pair[1].start));
                prop_assert_eq!(all.last().map_or(0, |place| place.end), store.end);
                prop_assert!(store.free.iter().all(|(at, free)| !store.free.contains_key(&(at + free)) && at + free < store.end));
            }
            taken.into_iter().for_each(|place| store.free(place));
            prop_assert!(store.free.is_empty() && store.end == 0);
        }
    }
}
