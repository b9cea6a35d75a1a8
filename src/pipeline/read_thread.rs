//! Decodes frames ahead of the tracker and keeps the replay's clock.

use std::time::{Duration, Instant};

use crossbeam::channel::{Sender, TrySendError};

use super::Progress;
use crate::sequence::{Frame, Sequence};

/// Result of the reading thread.
#[derive(Clone, Debug, Default)]
pub(super) struct ReadSummary {
    pub read_failed: usize,
    pub first_failure: Option<String>,
    /// Real time: frames that became due while the channel was full.
    pub late: usize,
}

/// Sends every readable frame, in order. Real-time replay waits for each frame's timestamp and never blocks on the tracker.
pub(super) fn read(sequence: &Sequence, real_time: bool, sender: &Sender<Frame>, progress: &Progress) -> ReadSummary {
    let mut summary = ReadSummary::default();
    let started = Instant::now();
    let first_s = sequence.entries.first().map_or(0.0, |entry| entry.timestamp_s);
    for index in 0..sequence.entries.len() {
        if progress.stopped() {
            break;
        }
        let frame = match sequence.load(index) {
            Ok(frame) => frame,
            Err(error) => {
                tracing::warn!(frame = index, "skipped, it cannot be read: {error}");
                summary.read_failed += 1;
                summary.first_failure.get_or_insert_with(|| error.to_string());
                continue;
            }
        };
        if real_time {
            let due = Duration::try_from_secs_f64(frame.timestamp_s - first_s).unwrap_or_default();
            std::thread::sleep(due.saturating_sub(started.elapsed()));
            match sender.try_send(frame) {
                Ok(()) => {}
                Err(TrySendError::Full(_)) => summary.late += 1,
                Err(TrySendError::Disconnected(_)) => break,
            }
        } else if sender.send(frame).is_err() {
            break;
        }
    }
    summary
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::bounded;

    use super::*;
    use crate::synthetic::{self, CameraConfig, SceneConfig};

    const FRAMES: usize = 5;
    const CAPACITY: usize = 2;

    /// A tiny recording of a hundred frames per second, in a folder that goes with it.
    fn sequence() -> (tempfile::TempDir, Sequence) {
        let folder = tempfile::tempdir().unwrap();
        let camera = CameraConfig { width: 32, height: 24, fx: 26.0, fy: 26.0, cx: 15.5, cy: 11.5, ..CameraConfig::default() };
        let scene = SceneConfig { frames: FRAMES, fps: 100.0, camera, ..SceneConfig::default() };
        synthetic::generate(&scene, folder.path(), &|_, _| {}).unwrap();
        let sequence = Sequence::open(folder.path(), None, None).unwrap();
        (folder, sequence)
    }

    #[test]
    fn in_real_time_frames_that_find_the_channel_full_are_dropped_and_counted() {
        let (_folder, sequence) = sequence();
        let (sender, frames) = bounded(CAPACITY);
        let summary = read(&sequence, true, &sender, &Progress::default());
        assert_eq!((summary.late, summary.read_failed), (FRAMES - CAPACITY, 0));
        assert_eq!(frames.try_iter().map(|frame| frame.index).collect::<Vec<_>>(), [0, 1]);
    }

    #[test]
    fn deterministic_replay_drops_nothing() {
        let (_folder, sequence) = sequence();
        let (sender, frames) = bounded(CAPACITY);
        let (summary, read) = std::thread::scope(|scope| {
            let consumer = scope.spawn(|| frames.iter().count());
            let summary = read(&sequence, false, &sender, &Progress::default());
            drop(sender);
            (summary, consumer.join().unwrap())
        });
        assert_eq!((summary.late, read), (0, FRAMES));
    }
}
