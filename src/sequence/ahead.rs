//! Frames loaded ahead of their consumer, several at the same time.

use std::collections::VecDeque;

use crossbeam::channel::{Receiver, bounded};

use super::{Frame, Sequence, SequenceError};

impl Sequence {
    /// Loads frames in the given order, at most `ahead` before `consume` has returned from the first of them, and works on each with
    /// `prepare`; both on rayon's threads, so the caller must not be one of them. `consume` receives them in their order and ends the
    /// reading by `false`. A video is decoded by the caller's thread.
    pub fn read_ahead<T: Send>(
        &self,
        indices: impl IntoIterator<Item = usize>,
        ahead: usize,
        prepare: impl Fn(Frame) -> T + Sync,
        mut consume: impl FnMut(usize, Result<T, SequenceError>) -> bool,
    ) {
        let prepare = &prepare;
        let mut indices = indices.into_iter();
        rayon::in_place_scope(|scope| {
            let begin = |index: usize| {
                let (sender, loaded) = bounded(1);
                let decoded = (!self.has_random_access()).then(|| self.load(index));
                scope.spawn(move |_| {
                    // The consumer may have ended the reading.
                    let _ = sender.send(decoded.unwrap_or_else(|| self.load(index)).map(prepare));
                });
                (index, loaded)
            };
            let mut pending: VecDeque<(usize, Receiver<_>)> = indices.by_ref().take(ahead.max(1)).map(begin).collect();
            while let Some((index, loaded)) = pending.pop_front() {
                // Without a result the task has panicked, and so does the scope.
                let Ok(loaded) = loaded.recv() else { break };
                if !consume(index, loaded) {
                    break;
                }
                pending.extend(indices.next().map(begin));
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{self, CameraConfig, SceneConfig};

    #[test]
    fn frames_come_in_order_and_reading_ends_when_the_consumer_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let camera = CameraConfig { width: 32, height: 24, fx: 26.0, fy: 26.0, cx: 15.5, cy: 11.5, ..CameraConfig::default() };
        synthetic::generate(&SceneConfig { frames: 8, camera, ..SceneConfig::default() }, folder.path(), &|_, _| {}).unwrap();
        let mut sequence = Sequence::open(folder.path(), None, None).unwrap();
        std::fs::write(&sequence.entries[5].color, "").unwrap();
        let order = [3, 1, 5, 7, 0, 2];
        for ahead in [0, 1, 4, 20] {
            let mut seen = Vec::new();
            sequence.read_ahead(
                order,
                ahead,
                |frame| frame.index,
                |index, loaded| {
                    assert_eq!(loaded.ok(), (index != 5).then_some(index));
                    seen.push(index);
                    index != 0
                },
            );
            assert_eq!(seen, order[..5]);
        }
        sequence.entries.clear();
        sequence.read_ahead([], 3, |frame| frame.index, |_, _| unreachable!());
    }
}
