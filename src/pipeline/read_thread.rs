//! Decodes frames and extracts their features ahead of the tracker, and keeps the replay's clock.

use std::convert::Infallible;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crossbeam::channel::{Sender, TrySendError};

use super::Progress;
use crate::recording::Recording;
use crate::sequence::{Frame, Sequence};
use crate::tracking::{ExtractedFrame, FrontEnd, TrackingError};

/// Frames decoded and extracted at the same time, at most: as many as there are processors, up to this.
const MOST_AT_ONCE: usize = 8;

/// Real time: a frame that has waited so long for its decoder is dropped.
const LATE_AFTER: Duration = Duration::from_millis(250);

/// A frame on its way to the tracking thread.
#[derive(Debug)]
pub(super) struct QueuedFrame {
    pub frame: Frame,
    /// `None` where poses are known.
    pub extracted: Option<Result<ExtractedFrame, TrackingError>>,
}

/// Result of the reading thread.
#[derive(Clone, Debug, Default)]
pub(super) struct ReadSummary {
    pub read_failed: usize,
    pub first_failure: Option<String>,
    /// Real time: frames that became due while the channel was full, or were decoded too late.
    pub late: usize,
}

/// Input of the reading thread.
pub(super) struct ReadThread<'a> {
    sequence: &'a Sequence,
    front_end: Option<FrontEnd>,
    frames: Vec<usize>,
    real_time: bool,
    sender: &'a Sender<QueuedFrame>,
    progress: &'a Progress,
}

impl<'a> ReadThread<'a> {
    /// These frames of a recording, with features unless its poses are known.
    pub fn new(recording: &'a Recording, frames: Vec<usize>, sender: &'a Sender<QueuedFrame>, progress: &'a Progress) -> Self {
        let (sequence, config) = (recording.sequence(), recording.config());
        let front_end = || FrontEnd::new(sequence.camera, sequence.sensor, &config.tracking);
        let front_end = (!config.replay.known_poses).then(front_end);
        Self { sequence, front_end, frames, real_time: config.replay.real_time, sender, progress }
    }

    /// Sends every readable frame, in order. Real-time replay waits for each frame's timestamp and never blocks on the tracker.
    pub fn read(&self) -> ReadSummary {
        let mut summary = ReadSummary::default();
        // The recording's clock stands while the run is held.
        let (started, held_ms) = (Instant::now(), AtomicU64::new(0));
        let elapsed = || started.elapsed().saturating_sub(Duration::from_millis(held_ms.load(Ordering::Relaxed)));
        let first_s = self.sequence.entries.first().map_or(0.0, |entry| entry.timestamp_s);
        let due = |frame: &Frame| Duration::try_from_secs_f64(frame.timestamp_s - first_s).unwrap_or_default();
        let prepare = |frame: Frame| {
            // What is late already is not worth its features.
            let is_late = self.real_time && elapsed() > due(&frame) + LATE_AFTER;
            (!is_late).then(|| QueuedFrame { extracted: self.front_end.as_ref().map(|f| f.extract(&frame)), frame })
        };
        let ahead = rayon::current_num_threads().min(MOST_AT_ONCE);
        self.sequence.read_ahead(self.frames.iter().copied(), ahead, prepare, |index, loaded| {
            let queued = match loaded {
                Ok(Some(queued)) => queued,
                Ok(None) => {
                    summary.late += 1;
                    return !self.progress.stopped();
                }
                Err(error) => {
                    tracing::warn!(frame = index, "skipped, it cannot be read: {error}");
                    summary.read_failed += 1;
                    summary.first_failure.get_or_insert_with(|| error.to_string());
                    return !self.progress.stopped();
                }
            };
            let pause = self.progress.control().wait_while_paused(|| Ok::<_, Infallible>(())).unwrap_or_default();
            held_ms.fetch_add(pause.as_millis() as u64, Ordering::Relaxed);
            if self.real_time {
                std::thread::sleep(due(&queued.frame).saturating_sub(elapsed()));
                match self.sender.try_send(queued) {
                    Ok(()) => {}
                    Err(TrySendError::Full(_)) => summary.late += 1,
                    Err(TrySendError::Disconnected(_)) => return false,
                }
            } else if self.sender.send(queued).is_err() {
                return false;
            }
            !self.progress.stopped()
        });
        summary
    }
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::bounded;

    use super::*;
    use crate::synthetic::{self, CameraConfig, SceneConfig};
    use crate::tracking::TrackingConfig;

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

    fn thread<'a>(
        sequence: &'a Sequence,
        real_time: bool,
        sender: &'a Sender<QueuedFrame>,
        progress: &'a Progress,
    ) -> ReadThread<'a> {
        let front_end = Some(FrontEnd::new(sequence.camera, sequence.sensor, &TrackingConfig::default()));
        ReadThread { sequence, front_end, frames: (0..FRAMES).collect(), real_time, sender, progress }
    }

    #[test]
    fn in_real_time_frames_that_find_the_channel_full_are_dropped_and_counted() {
        let (_folder, sequence) = sequence();
        let (sender, frames) = bounded(CAPACITY);
        let summary = thread(&sequence, true, &sender, &Progress::default()).read();
        assert_eq!((summary.late, summary.read_failed), (FRAMES - CAPACITY, 0));
        assert_eq!(frames.try_iter().map(|queued| queued.frame.index).collect::<Vec<_>>(), [0, 1]);
    }

    #[test]
    fn deterministic_replay_drops_nothing() {
        let (_folder, sequence) = sequence();
        let (sender, frames) = bounded(CAPACITY);
        let (summary, read) = std::thread::scope(|scope| {
            let consumer = scope.spawn(|| frames.iter().count());
            let summary = thread(&sequence, false, &sender, &Progress::default()).read();
            drop(sender);
            (summary, consumer.join().unwrap())
        });
        assert_eq!((summary.late, read), (0, FRAMES));
    }
}
