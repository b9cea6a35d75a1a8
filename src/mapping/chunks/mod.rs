//! Out-of-core mapping: Gaussians that no keyframe near by sees leave the GPU for the disk, and come back when one does, as in DiskChunGS.
//!
//! A chunk is up to 16 neighbours, divided anew each time Gaussians leave. A box around it says which keyframes see it.

mod boxes;
mod index;
mod sight;
mod store;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};

pub(super) use self::boxes::{OrientedBox, parts};
use self::index::Index;
pub(super) use self::sight::{Hidden, Outlook, Sight};
use self::store::{Store, Stored};
use super::{KeyframeId, MappingError};
use crate::geometry::Sim3;
use crate::render::CloudPart;
use crate::splat::{GaussianCloud, ShDegree};

/// Number of a chunk, in the order in which they left.
pub(super) type ChunkId = u64;

/// What went to the disk, and what came back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PagingFigures {
    /// Gaussians that left the GPU, counted each time.
    pub gaussians_out: u64,
    /// Gaussians that came back.
    pub gaussians_in: u64,
    /// The most that were away at a time.
    pub most_away: u64,
}

/// Gaussians with the keyframes that they were inserted from.
pub(super) struct Members {
    pub part: CloudPart,
    /// `[N]`
    pub keyframes: Vec<KeyframeId>,
}

/// Neighbouring Gaussians that are not on the GPU.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Chunk {
    bounds: OrientedBox,
    gaussians: usize,
    /// Round of density control in which it left.
    round: u32,
    /// Number of Gaussians of each keyframe,
    keyframes: BTreeMap<KeyframeId, usize>,
    /// and how these have moved since.
    motions: BTreeMap<KeyframeId, Sim3>,
    stored: Stored,
}

/// A chunk that has come back, and whose place in the file may not be used again yet.
#[derive(Debug)]
struct Returned {
    id: ChunkId,
    chunk: Chunk,
    in_snapshot: bool,
    in_checkpoint: bool,
}

/// All Gaussians that are not on the GPU.
#[derive(Debug)]
pub(super) struct Chunks {
    state: ChunksState,
    index: Index,
    returned: Vec<Returned>,
    downloaded: Mutex<Downloaded>,
    store: Store,
    /// Chunks from this number on left after the last checkpoint.
    checkpoint_before: ChunkId,
}

/// The last download of the Gaussians on the GPU.
#[derive(Clone, Copy, Debug, Default)]
struct Downloaded {
    /// Chunks from this number on left after it.
    before: ChunkId,
    /// So many of [`Chunks::returned`] had come back before it, where these have not been looked through since.
    returned: usize,
}

/// The chunks of a checkpoint; their Gaussians lie in a file beside it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct ChunksState {
    away: BTreeMap<ChunkId, Chunk>,
    next: ChunkId,
    /// Gaussians of all that are away.
    gaussians: usize,
    figures: PagingFigures,
}

impl Chunks {
    /// None yet. What leaves the GPU goes to the file, where that of an earlier run is removed, or to an unnamed one. What a checkpoint names stays there
    /// until the next.
    pub fn begin(file: Option<PathBuf>) -> Self {
        Self::with(ChunksState::default(), Store::begin(file))
    }

    /// Those of a checkpoint.
    ///
    /// # Errors
    /// If the file is missing or too short.
    pub fn restore(file: Option<PathBuf>, state: &ChunksState) -> Result<Self, MappingError> {
        let store = Store::restore(file, state.away.values().map(|chunk| &chunk.stored))?;
        Ok(Self { checkpoint_before: state.next, ..Self::with(state.clone(), store) })
    }

    fn with(state: ChunksState, store: Store) -> Self {
        Self { index: state.index(), state, returned: Vec::new(), downloaded: Mutex::default(), store, checkpoint_before: 0 }
    }

    /// What a checkpoint needs. The file is flushed to the disk.
    ///
    /// # Errors
    /// If it cannot be.
    pub fn state(&self) -> Result<ChunksState, MappingError> {
        self.store.flush()?;
        Ok(self.state.clone())
    }

    /// A checkpoint of the present state has been written.
    pub fn checkpoint_is_written(&mut self) {
        self.checkpoint_before = self.state.next;
        self.returned.iter_mut().for_each(|returned| returned.in_checkpoint = false);
        self.reuse_places();
    }

    /// The Gaussians on the GPU have been downloaded. Returns which ones are away now; they stay on the disk until the next download.
    pub fn snapshot(&self) -> BTreeSet<ChunkId> {
        *self.downloaded.lock().unwrap_or_else(PoisonError::into_inner) =
            Downloaded { before: self.state.next, returned: self.returned.len() };
        self.away()
    }

    fn reuse_places(&mut self) {
        let Self { returned, downloaded, store, .. } = self;
        let downloaded = downloaded.get_mut().unwrap_or_else(PoisonError::into_inner);
        let before = std::mem::take(&mut downloaded.returned);
        returned[..before].iter_mut().for_each(|returned| returned.in_snapshot = false);
        returned.retain(|returned| {
            let is_kept = returned.in_snapshot || returned.in_checkpoint;
            if !is_kept {
                store.give_back(&returned.chunk.stored);
            }
            is_kept
        });
    }

    pub fn figures(&self) -> PagingFigures {
        self.state.figures
    }

    /// Whether all Gaussians are on the GPU.
    pub fn are_here(&self) -> bool {
        self.state.away.is_empty()
    }

    /// Number of Gaussians that are not on the GPU.
    pub fn gaussians_away(&self) -> usize {
        self.state.gaussians
    }

    /// Number of Gaussians of a chunk.
    pub fn gaussians(&self, chunk: ChunkId) -> usize {
        self.state.away[&chunk].gaussians
    }

    /// Where a view sees something that is away; nothing where it sees nothing of that.
    pub fn hidden_from(&self, outlook: &Outlook<'_>) -> Option<Hidden> {
        let mut seen = self.index.seen_by(outlook).peekable();
        seen.peek()?;
        let mut hidden = outlook.nothing_hidden();
        seen.for_each(|(_, bounds)| outlook.hide(bounds, &mut hidden));
        Some(hidden)
    }

    /// Whether all is here that this share of a view's image shows.
    pub fn is_here(&self, outlook: &Outlook<'_>, share: f32) -> bool {
        let mut hidden = outlook.nothing_hidden();
        self.index.seen_by(outlook).all(|(_, bounds)| {
            outlook.hide(bounds, &mut hidden);
            hidden.seen() >= share
        })
    }

    /// Chunks that a view sees, the nearest first.
    pub fn seen_by(&self, outlook: &Outlook<'_>) -> Vec<ChunkId> {
        let mut seen: Vec<(f32, ChunkId)> = self.index.seen_by(outlook).map(|(id, bounds)| (outlook.depth(bounds), id)).collect();
        seen.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        seen.into_iter().map(|(_, id)| id).collect()
    }

    /// Takes in Gaussians that leave the GPU in this round of density control.
    pub fn put(&mut self, members: &Members, round: u32) {
        self.reuse_places();
        let id = self.state.next;
        self.state.next += 1;
        let mut keyframes = BTreeMap::new();
        members.keyframes.iter().for_each(|keyframe| *keyframes.entry(*keyframe).or_default() += 1);
        let chunk = Chunk {
            bounds: OrientedBox::around(&members.part.extents()),
            gaussians: members.part.len(),
            round,
            keyframes,
            motions: BTreeMap::new(),
            stored: self.store.put(members),
        };
        self.state.gaussians += chunk.gaussians;
        self.state.figures.gaussians_out += chunk.gaussians as u64;
        self.state.figures.most_away = self.state.figures.most_away.max(self.state.gaussians as u64);
        self.index.insert(id, chunk.bounds);
        self.index.name(id, chunk.keyframes.keys());
        self.state.away.insert(id, chunk);
    }

    /// A chunk that comes back in this round: as it left, but for how its keyframes have moved since.
    ///
    /// # Errors
    /// If it cannot be read or has changed.
    pub fn get(&self, chunk: ChunkId, sh_degree: ShDegree, round: u32) -> Result<Members, MappingError> {
        let chunk = &self.state.away[&chunk];
        let mut members = self.read(chunk, sh_degree)?;
        members.part.rejuvenate(round - chunk.round);
        Ok(members)
    }

    fn read(&self, chunk: &Chunk, sh_degree: ShDegree) -> Result<Members, MappingError> {
        let mut members = self.store.get(&chunk.stored, chunk.gaussians, sh_degree)?;
        for (keyframe, new_from_old) in &chunk.motions {
            let moved: Vec<usize> = (0..chunk.gaussians).filter(|i| members.keyframes[*i] == *keyframe).collect();
            members.part.transform(&moved, new_from_old);
        }
        Ok(members)
    }

    /// A chunk is on the GPU again.
    pub fn is_back(&mut self, id: ChunkId) {
        self.state.figures.gaussians_in += self.gaussians(id) as u64;
        self.forget(id);
    }

    fn forget(&mut self, id: ChunkId) {
        let Some(chunk) = self.state.away.remove(&id) else { return };
        self.state.gaussians -= chunk.gaussians;
        self.index.remove(id, &chunk.bounds);
        self.index.forget(id, chunk.keyframes.keys());
        let downloaded = self.downloaded.get_mut().unwrap_or_else(PoisonError::into_inner);
        self.returned.push(Returned {
            id,
            chunk,
            in_snapshot: id < downloaded.before,
            in_checkpoint: id < self.checkpoint_before,
        });
    }

    /// Keyframes have moved, and their Gaussians with them; returns how many of these are away.
    pub fn transform(&mut self, motions: &BTreeMap<KeyframeId, Sim3>) -> usize {
        let Self { state, index, .. } = self;
        let mut moved = 0;
        for id in index.of_keyframes(motions.keys()) {
            let Some(chunk) = state.away.get_mut(&id) else { continue };
            index.remove(id, &chunk.bounds);
            let mut reached: Vec<OrientedBox> = Vec::new();
            for (keyframe, gaussians) in &chunk.keyframes {
                let mut bounds = chunk.bounds;
                if let Some(new_from_old) = motions.get(keyframe) {
                    moved += gaussians;
                    let before = chunk.motions.get(keyframe).copied().unwrap_or(Sim3::identity());
                    chunk.motions.insert(*keyframe, *new_from_old * before);
                    bounds.transform(new_from_old);
                }
                reached.push(bounds);
            }
            chunk.bounds = OrientedBox::around_boxes(&reached);
            index.insert(id, chunk.bounds);
        }
        moved
    }

    /// Removes the Gaussians of keyframes; returns how many were away.
    ///
    /// # Errors
    /// If a chunk with Gaussians of others, too, cannot be read.
    pub fn remove(&mut self, keyframes: &BTreeSet<KeyframeId>, sh_degree: ShDegree) -> Result<usize, MappingError> {
        let before = self.gaussians_away();
        for id in self.index.of_keyframes(keyframes) {
            let chunk = &self.state.away[&id];
            let members = self.read(chunk, sh_degree)?;
            let stay: Vec<usize> = (0..chunk.gaussians).filter(|i| !keyframes.contains(&members.keyframes[*i])).collect();
            let round = chunk.round;
            self.forget(id);
            if !stay.is_empty() {
                self.put(&members.picked(&stay), round);
            }
        }
        Ok(before - self.gaussians_away())
    }

    /// Adds the Gaussians of chunks that were away at a download to what was downloaded, as they are shown.
    ///
    /// # Errors
    /// If one cannot be read or has changed.
    pub fn complete(&self, map: &mut GaussianCloud, away: &BTreeSet<ChunkId>) -> Result<(), MappingError> {
        let (sh_degree, antialiased) = (map.sh_degree, map.antialiased);
        let returned = self.returned.iter().map(|returned| (&returned.id, &returned.chunk));
        for (_, chunk) in self.state.away.iter().chain(returned).filter(|(id, _)| away.contains(id)) {
            map.append(&self.read(chunk, sh_degree)?.part.shown(sh_degree, antialiased));
        }
        Ok(())
    }

    /// All that are away.
    pub fn away(&self) -> BTreeSet<ChunkId> {
        self.state.away.keys().copied().collect()
    }
}

impl ChunksState {
    fn index(&self) -> Index {
        let mut index: Index = self.away.iter().map(|(id, chunk)| (*id, &chunk.bounds)).collect();
        self.away.iter().for_each(|(id, chunk)| index.name(*id, chunk.keyframes.keys()));
        index
    }
}

impl Members {
    /// Some of them.
    pub fn picked(&self, which: &[usize]) -> Self {
        Self { part: self.part.picked(which), keyframes: which.iter().map(|i| self.keyframes[*i]).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a checkpoint or a download names stays where it is until the next one; all else that has come back makes room at once.
    #[test]
    fn the_file_grows_by_what_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("chunks.bin");
        let mut chunks = Chunks::begin(Some(file.clone()));
        let leave = |chunks: &mut Chunks| chunks.put(&Members { part: CloudPart::default(), keyframes: vec![3; 5] }, 0);
        let come_back = |chunks: &mut Chunks| (chunks.away().into_iter()).for_each(|id| chunks.is_back(id));
        let round_trips = |chunks: &mut Chunks| {
            (0..4).for_each(|_| {
                leave(chunks);
                come_back(chunks);
            });
            std::fs::metadata(&file).unwrap().len()
        };
        let one = round_trips(&mut chunks);
        assert!(one > 0 && round_trips(&mut chunks) == one);
        leave(&mut chunks);
        chunks.state().unwrap();
        chunks.checkpoint_is_written();
        come_back(&mut chunks);
        assert_eq!(round_trips(&mut chunks), 2 * one);
        leave(&mut chunks);
        assert_eq!(chunks.snapshot().len(), 1);
        come_back(&mut chunks);
        assert_eq!(round_trips(&mut chunks), 3 * one);
        chunks.checkpoint_is_written();
        assert!(chunks.snapshot().is_empty());
        leave(&mut chunks);
        assert_eq!(chunks.returned.len(), 0);
        assert_eq!(round_trips(&mut chunks), 3 * one);
    }
}
