//! What viewers may see of a run or its files: the newest of each kind, which any number of connections read.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

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
    /// Each with its number.
    entries: Vec<(usize, Statistics)>,
    /// Entries ever added.
    pub last: usize,
}

impl History {
    /// Appends an entry. When there are too many, every second one of all but the newest few is dropped.
    pub fn push(&mut self, entry: Statistics) {
        const KEPT: usize = 16;
        if self.entries.len() >= MOST_STATISTICS {
            let old = self.entries.len() - KEPT;
            let mut place = 0;
            self.entries.retain(|_| {
                place += 1;
                place > old || place % 2 == 1
            });
        }
        self.last += 1;
        self.entries.push((self.last, entry));
    }

    /// The entries that are kept of those after the `seen` first.
    pub fn since(&self, seen: usize) -> Vec<Statistics> {
        let start = self.entries.partition_point(|(number, _)| *number <= seen);
        self.entries[start..].iter().map(|(_, entry)| *entry).collect()
    }

    /// The newest entry.
    pub fn newest(&self) -> Option<&Statistics> {
        self.entries.last().map(|(_, entry)| entry)
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
    /// Whether there has been a viewer.
    pub was_watched: AtomicBool,
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
            was_watched: AtomicBool::new(false),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_history_is_thinned_and_nothing_is_sent_twice() {
        let mut history = History::default();
        let mut sent = Vec::new();
        for s in 0..5000 {
            let seen = history.last;
            history.push(Statistics { s: f64::from(s), ..Statistics::default() });
            sent.extend(history.since(seen));
        }
        assert_eq!(sent.iter().map(|entry| entry.s).collect::<Vec<_>>(), (0..5000).map(f64::from).collect::<Vec<_>>());
        let whole = history.since(0);
        assert!((MOST_STATISTICS / 2..=MOST_STATISTICS).contains(&whole.len()) && whole[0].s == 0.0);
        assert!(whole.is_sorted_by(|a, b| a.s < b.s) && history.newest().unwrap().s == 4999.0);
    }
}
