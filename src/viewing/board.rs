//! What viewers may see of a run or its files: the newest of each kind, which any number of connections read.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use arc_swap::{ArcSwap, ArcSwapOption};
use tokio::sync::watch;

use super::packing::PackedMap;
use super::protocol::{CameraPath, CurrentView, Hello, KeyframeView, Outgoing, Statistics};

/// Statistics that a viewer gets when it comes.
const MOST_STATISTICS: usize = 600;

/// Keyframes, loops and the newest frame.
#[derive(Clone, Debug, Default)]
pub struct Frames {
    /// All of them, ascending by id.
    pub keyframes: Vec<KeyframeView>,
    /// Pairs of ids.
    pub loops: Vec<[usize; 2]>,
    /// The newest frame.
    pub current: Option<CurrentView>,
}

/// Statistics so far; older ones are thinned.
#[derive(Clone, Debug, Default)]
pub struct History {
    entries: VecDeque<Statistics>,
    /// Entries ever added.
    pub last: usize,
}

impl History {
    /// Appends an entry. When there are too many, every second one of all but the newest few is dropped.
    pub fn push(&mut self, entry: Statistics) {
        const KEPT: usize = 16;
        if self.entries.len() >= MOST_STATISTICS {
            let old = self.entries.len() - KEPT;
            let entries = self.entries.iter().enumerate().filter(|(k, _)| *k >= old || k.is_multiple_of(2));
            self.entries = entries.map(|(_, entry)| *entry).collect();
        }
        self.entries.push_back(entry);
        self.entries.make_contiguous();
        self.last += 1;
    }

    /// Entries after the `seen` first; all where none was seen, or more were added than are kept whole.
    pub fn since(&self, seen: Option<usize>) -> &[Statistics] {
        let entries = self.entries.as_slices().0;
        let new = seen.map_or(entries.len(), |seen| (self.last - seen).min(entries.len()));
        &entries[entries.len() - new..]
    }

    /// The newest entry.
    pub fn newest(&self) -> Option<&Statistics> {
        self.entries.back()
    }
}

/// A picture for all viewers.
#[derive(Clone, Debug)]
pub struct NumberedImage {
    /// Differs from those before it.
    pub number: u64,
    /// The encoded message.
    pub message: Outgoing,
}

/// The newest of everything. Writers replace values whole; readers never wait.
#[derive(Debug)]
pub struct Board {
    /// The first message of each connection, with `control` as for this machine.
    pub hello: Hello,
    /// The newest packed map.
    pub map: ArcSwapOption<PackedMap>,
    /// The newest poses.
    pub frames: ArcSwapOption<Frames>,
    /// The camera's path, where it is known as a whole.
    pub path: ArcSwapOption<CameraPath>,
    /// Figures over time.
    pub statistics: ArcSwap<History>,
    /// Image of the newest frame.
    pub image: ArcSwapOption<NumberedImage>,
    /// Viewers connected.
    pub viewers: AtomicUsize,
    /// Viewers that have all of the newest map, and would take another.
    pub ready: AtomicUsize,
    /// Viewers that want images of the newest frame.
    pub watching: AtomicUsize,
    changed: watch::Sender<u64>,
}

impl Board {
    /// A board with nothing on it yet.
    pub fn new(hello: Hello) -> Self {
        Self {
            hello,
            map: ArcSwapOption::empty(),
            frames: ArcSwapOption::empty(),
            path: ArcSwapOption::empty(),
            statistics: ArcSwap::default(),
            image: ArcSwapOption::empty(),
            viewers: AtomicUsize::new(0),
            ready: AtomicUsize::new(0),
            watching: AtomicUsize::new(0),
            changed: watch::Sender::new(0),
        }
    }

    /// Wakes the connections.
    pub fn announce(&self) {
        self.changed.send_modify(|count| *count += 1);
    }

    /// Resolves at each announcement.
    pub fn subscribe(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Whether a viewer would take a newer map.
    pub fn wants_map(&self) -> bool {
        self.ready.load(Ordering::Relaxed) > 0
    }
}

/// Replaces a value.
pub fn put<T>(slot: &ArcSwapOption<T>, value: T) {
    slot.store(Some(Arc::new(value)));
}
