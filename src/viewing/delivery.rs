//! What one viewer has, and what it gets next: newest wins, and chunks that differ, the longest unsent first.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use super::board::{Board, Frames};
use super::packing::{PackedMap, Part, PartId};
use super::protocol::{ChunkHeader, KeyframeView, MOST_TO_VIEWER, MapHeader, Outgoing, ToViewer};

/// Bytes of a `map` message: at first, and at least. They follow the speed of the connection.
const FIRST_BYTES: usize = 1 << 20;
const LEAST_BYTES: usize = 64 << 10;
/// A message that took less time is followed by a larger one, one that took more by a smaller one.
const QUICK: Duration = Duration::from_millis(500);
const SLOW: Duration = Duration::from_secs(5);
/// Room for the header of a `map` message.
const MOST_HEADER: usize = 256 << 10;
/// A chunk's line in that header takes no more.
const CHUNK_HEADER: usize = 160;
/// Keyframes of one `poses` message; more follow in the next.
const MOST_KEYFRAMES: usize = 10_000;

/// What a viewer holds of a part.
#[derive(Clone, Copy, Debug)]
struct Held {
    digest: u64,
    /// Number of the message that brought it.
    sent: u64,
}

/// What one viewer has.
#[derive(Debug)]
pub struct Delivery {
    parts: BTreeMap<PartId, Held>,
    /// Width of the grid and words of a Gaussian that the parts are of.
    form: Option<(i32, u8)>,
    /// Revision that the viewer has all of.
    complete: Option<u64>,
    messages: u64,
    /// A `map` message that has not been acknowledged.
    in_flight: Option<u64>,
    /// Bytes of the next `map` message.
    bytes: usize,
    frames: Option<Arc<Frames>>,
    keyframes: BTreeMap<usize, KeyframeView>,
    loops: usize,
    path: Option<Arc<super::protocol::CameraPath>>,
    statistics: usize,
    image: Option<u64>,
    /// Whether images of the newest frame are wanted.
    pub wants_images: bool,
}

impl Default for Delivery {
    fn default() -> Self {
        Self {
            parts: BTreeMap::new(),
            form: None,
            complete: None,
            messages: 0,
            in_flight: None,
            bytes: FIRST_BYTES,
            frames: None,
            keyframes: BTreeMap::new(),
            loops: 0,
            path: None,
            statistics: 0,
            image: None,
            wants_images: false,
        }
    }
}

impl Delivery {
    /// Fits the size of messages to the connection: a message took so long to be sent.
    pub fn sent(&mut self, bytes: usize, time: Duration) {
        if time > SLOW {
            self.bytes = (self.bytes / 2).max(LEAST_BYTES);
        } else if time < QUICK && 2 * bytes > self.bytes {
            self.bytes = (2 * self.bytes).min(MOST_TO_VIEWER - MOST_HEADER);
        }
    }

    /// The viewer has taken a `map` message.
    pub fn taken(&mut self, revision: u64) {
        if self.in_flight == Some(revision) {
            self.in_flight = None;
        }
    }

    /// Whether it has all of this snapshot, so that a newer one is of use.
    pub fn has_all_of(&self, revision: u64) -> bool {
        self.in_flight.is_none() && self.complete == Some(revision)
    }

    /// The next message, if there is anything new; small ones first.
    pub fn next(&mut self, board: &Board) -> Option<Outgoing> {
        self.poses(board)
            .or_else(|| self.path(board))
            .or_else(|| self.statistics(board))
            .or_else(|| self.image(board))
            .or_else(|| self.map(board))
    }

    fn poses(&mut self, board: &Board) -> Option<Outgoing> {
        let frames = board.frames.load_full()?;
        let is_new = self.frames.as_ref().is_none_or(|sent| !Arc::ptr_eq(sent, &frames));
        if !is_new {
            return None;
        }
        let gone = self.keyframes.keys().any(|id| frames.keyframes.binary_search_by_key(id, |view| view.id).is_err());
        let all = self.frames.is_none() || gone;
        if all {
            self.keyframes.clear();
        }
        let differs = |view: &&KeyframeView| self.keyframes.get(&view.id) != Some(*view);
        let mut keyframes: Vec<KeyframeView> = frames.keyframes.iter().filter(differs).copied().collect();
        let is_whole = keyframes.len() <= MOST_KEYFRAMES;
        keyframes.truncate(MOST_KEYFRAMES);
        self.keyframes.extend(keyframes.iter().map(|view| (view.id, *view)));
        let loops = (all || self.loops != frames.loops.len()).then_some(&*frames.loops);
        self.loops = frames.loops.len();
        let message = Outgoing::text(&ToViewer::Poses { all, keyframes, loops, current: frames.current });
        // The rest of a list that was cut is still new.
        self.frames = Some(if is_whole { frames } else { Arc::default() });
        Some(message)
    }

    fn path(&mut self, board: &Board) -> Option<Outgoing> {
        let path = board.path.load_full()?;
        let is_new = self.path.as_ref().is_none_or(|sent| !Arc::ptr_eq(sent, &path));
        self.path = Some(path.clone());
        is_new.then(|| Outgoing::text(&ToViewer::Path(&path)))
    }

    fn statistics(&mut self, board: &Board) -> Option<Outgoing> {
        let history = board.statistics.load_full();
        let new = history.since(self.statistics);
        self.statistics = history.last;
        (!new.is_empty()).then(|| Outgoing::text(&ToViewer::Statistics { entries: &new }))
    }

    fn image(&mut self, board: &Board) -> Option<Outgoing> {
        let image = board.image.load_full().filter(|image| self.wants_images && self.image != Some(image.number))?;
        self.image = Some(image.number);
        Some(image.message.clone())
    }

    fn map(&mut self, board: &Board) -> Option<Outgoing> {
        let map = board.map.load_full().filter(|map| self.in_flight.is_none() && self.complete != Some(map.revision))?;
        let form = (map.width, map.sh_degree.get());
        let reset = self.form != Some(form);
        if reset {
            self.parts.clear();
            self.form = Some(form);
        }
        let (chosen, complete) = self.choose(&map);
        self.messages += 1;
        for part in &chosen {
            self.parts.insert(part.id, Held { digest: part.digest, sent: self.messages });
        }
        let gone = self.gone(&map);
        for id in &gone {
            self.parts.remove(id);
        }
        let removed = gone.iter().map(|id| ChunkHeader { at: id.at, part: id.part, count: 0, sh_scale: 0.0 });
        let chunk = |part: &&Arc<Part>| {
            let Part { id, count, sh_scale, .. } = ***part;
            ChunkHeader { at: id.at, part: id.part, count, sh_scale }
        };
        let header = MapHeader {
            revision: map.revision,
            reset,
            complete,
            gaussians: map.gaussians,
            sh_degree: map.sh_degree.get(),
            antialiased: map.antialiased,
            cell: map.cell_metres(),
            chunks: removed.chain(chosen.iter().map(|part| chunk(&part))).collect(),
        };
        self.in_flight = Some(map.revision);
        if complete {
            self.complete = Some(map.revision);
        }
        Some(Outgoing::binary(&ToViewer::Map(header), |bytes| {
            chosen.iter().for_each(|part| bytes.extend_from_slice(bytemuck::cast_slice(&part.words)));
        }))
    }

    /// Parts that differ from those held, as many as a message holds, the longest unsent first; and whether these are all.
    fn choose(&self, map: &PackedMap) -> (Vec<Arc<Part>>, bool) {
        let differs = |part: &&Arc<Part>| self.parts.get(&part.id).is_none_or(|held| held.digest != part.digest);
        let mut parts: Vec<&Arc<Part>> = map.parts.iter().filter(differs).collect();
        parts.sort_by_key(|part| self.parts.get(&part.id).map_or(0, |held| held.sent));
        let all = parts.len();
        let mut room = self.bytes;
        let mut lines = MOST_HEADER / CHUNK_HEADER / 2;
        let mut is_first = true;
        let fits = |part: &&Arc<Part>| {
            let bytes = 4 * part.words.len();
            let fits = (bytes <= room || std::mem::take(&mut is_first)) && lines > 0;
            is_first = false;
            (room, lines) = (room.saturating_sub(bytes), lines.saturating_sub(1));
            fits
        };
        let chosen: Vec<Arc<Part>> = parts.into_iter().take_while(fits).cloned().collect();
        let complete = chosen.len() == all && self.gone(map).len() < MOST_HEADER / CHUNK_HEADER / 2;
        (chosen, complete)
    }

    /// Held parts that the snapshot does not have, as many as a message names.
    fn gone(&self, map: &PackedMap) -> Vec<PartId> {
        let has = |id: &PartId| map.parts.binary_search_by_key(id, |part| part.id).is_ok();
        self.parts.keys().filter(|id| !has(id)).take(MOST_HEADER / CHUNK_HEADER / 2).copied().collect()
    }
}

#[cfg(test)]
#[path = "delivery_tests.rs"]
mod tests;
