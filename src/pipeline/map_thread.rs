//! The mapping thread: maps keyframes as they arrive, refines the map after the last one, and publishes a snapshot after each.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::Receiver;

use super::progress::guarded;
use super::read_thread::QueuedFrame;
use super::{PipelineError, Progress};
use crate::evaluation::machine;
use crate::gpu::Gpu;
use crate::mapping::{FinalRefinement, KeyframeId, KeyframeReport, Mapper, MapperMessage, MappingConfig, MappingError};
use crate::run_folder::{CheckpointError, Checkpointer, KeyframeRecord, RunState};
use crate::splat::{Exposure, GaussianCloud, MapSnapshot};

/// Real time: the mapper pauses between two batches of steps while more frames than this wait for the tracker,
const MOST_WAITING: usize = 2;
/// but never longer than this.
const LONGEST_PAUSE: Duration = Duration::from_millis(200);

/// Result of the mapping thread, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct MapSummary {
    /// The map after the last keyframe that was finished.
    pub cloud: Arc<GaussianCloud>,
    pub keyframes: Vec<KeyframeRecord>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    /// The thread ended before it reached its checkpoint; there is nothing to write.
    pub behind: bool,
    pub error: Option<PipelineError>,
}

/// The map after a round of its refinement.
pub(super) struct Round<'a> {
    pub cloud: &'a Arc<GaussianCloud>,
    /// All optimisation steps so far.
    pub steps: usize,
}

/// Input of the mapping thread.
#[derive(Clone, Copy)]
pub(super) struct MapThread<'a> {
    pub gpu: &'a Arc<Gpu>,
    pub config: &'a MappingConfig,
    pub messages: &'a Receiver<MapperMessage>,
    /// Real time: frames that wait for the tracker.
    pub frames: Option<&'a Receiver<QueuedFrame>>,
    pub progress: &'a Progress,
}

/// The mapper at the start of the thread's work.
struct Start {
    mapper: Mapper,
    cloud: Arc<GaussianCloud>,
    /// State of a final refinement that a resumed run had begun.
    refinement: Option<FinalRefinement>,
    records: Vec<KeyframeRecord>,
}

impl MapThread<'_> {
    /// Maps until the tracker closes the channel, then refines; or until an error. `on_round` receives each round of the final refinement.
    /// With a checkpointer, continues from its state and writes checkpoints.
    pub fn map(self, on_round: &mut dyn FnMut(Round<'_>), mut checkpointer: Option<Checkpointer>) -> MapSummary {
        let behind = checkpointer.as_ref().is_some_and(Checkpointer::is_behind);
        let start = guarded("mapping", || self.start(checkpointer.as_mut()));
        let Start { mut mapper, cloud, refinement, records } = match start {
            Ok(start) => start,
            Err(error) => return MapSummary { behind, error: Some(error), ..MapSummary::default() },
        };
        let mut summary = MapSummary { cloud, keyframes: records, ..MapSummary::default() };
        let mut checkpoints = Checkpoints { checkpointer, failed: false };
        let mut snapshots = Snapshots::default();
        let mapped = self.map_messages(&mut mapper, &mut summary, &mut snapshots, &mut checkpoints);
        summary.error = mapped.err();
        // Also after an error: a device that still answers gives all that was mapped.
        let last = guarded("mapping", || snapshots.last(&mapper, &mut summary, self.progress));
        summary.error = summary.error.or(last.err());
        if summary.error.is_none() && mapper.has_not_begun() && !summary.keyframes.is_empty() {
            summary.error = Some(MappingError::NoDepth.into());
        }
        if summary.error.is_none() {
            let refined = guarded("mapping", || self.refine(&mut mapper, &mut summary, refinement, &mut checkpoints, on_round));
            summary.error = refined.err();
        }
        summary.step_ms = mapper.step_times().iter().map(|t| t.as_secs_f64() * 1e3).collect();
        summary
    }

    /// A new mapper and an empty map, or those of a checkpoint.
    fn start(&self, checkpointer: Option<&mut Checkpointer>) -> Result<Start, PipelineError> {
        if let Some(checkpointer) = checkpointer
            && let Some(state) = checkpointer.take_state()
        {
            return self.catch_up(checkpointer, state);
        }
        let mapper = Mapper::new(self.gpu.clone(), self.config)?;
        Ok(Start { mapper, cloud: Arc::default(), refinement: None, records: Vec::new() })
    }

    /// Replays the messages up to a checkpoint: uploads keyframe images.
    ///
    /// # Errors
    /// If the messages end before the checkpoint, or differ from those before the interruption.
    fn catch_up(&self, checkpointer: &mut Checkpointer, state: RunState) -> Result<Start, PipelineError> {
        let path = checkpointer.path().to_owned();
        let not_repeated = || PipelineError::NotRepeated { checkpoint: path.clone() };
        let explained = |error| match error {
            MappingError::State => CheckpointError::Damaged { path: path.clone() }.into(),
            MappingError::NotTheSame { .. } => not_repeated(),
            error => error.into(),
        };
        let mut mapper = Mapper::restore(self.gpu.clone(), self.config, &state.mapper).map_err(explained)?;
        let records = state.records();
        while checkpointer.digest().messages < state.digest.messages {
            let Ok(message) = self.messages.recv() else { return Err(PipelineError::NotCaughtUp { checkpoint: path }) };
            checkpointer.received(&message);
            if let MapperMessage::Keyframe(keyframe) = message {
                mapper.insert_again(&keyframe, &state.mapper).map_err(explained)?;
            }
        }
        if checkpointer.digest() != state.digest {
            return Err(not_repeated());
        }
        tracing::info!(keyframes = records.len(), gaussians = mapper.gaussians(), "checkpoint reached");
        let cloud = Arc::new(mapper.download()?);
        Ok(Start { mapper, cloud, refinement: state.mapper.into_refinement(), records })
    }

    fn map_messages(
        &self,
        mapper: &mut Mapper,
        summary: &mut MapSummary,
        snapshots: &mut Snapshots,
        checkpoints: &mut Checkpoints,
    ) -> Result<(), PipelineError> {
        let earlier_s = summary.keyframes.last().map_or(0.0, |record| record.done_s);
        let started = Instant::now();
        let inbox = Inbox { messages: self.messages, ahead: RefCell::default() };
        while let Some(message) = inbox.next() {
            let (waiting, began) = (inbox.waiting(), Instant::now());
            let stop = || {
                self.frames.into_iter().for_each(wait_for_tracker);
                self.progress.stopped() || (self.config.yields_to_keyframes && inbox.keyframe_waits())
            };
            checkpoints.checkpointer.iter_mut().for_each(|c| c.received(&message));
            let Processed { report, changed } = guarded("mapping", || self.process(mapper, message, &stop))?;
            tracing::debug!(?report, "message processed");
            let record = |report| KeyframeRecord {
                report,
                done_s: earlier_s + started.elapsed().as_secs_f64(),
                busy_s: began.elapsed().as_secs_f64(),
                waiting,
                host_bytes: machine::host_bytes(),
            };
            summary.keyframes.extend(report.map(record));
            snapshots.is_stale |= changed;
            if snapshots.is_due() {
                guarded("mapping", || snapshots.take(mapper, summary, self.progress))?;
            }
            // A keyframe that was cut short differs from that of an unbroken run.
            if report.is_some() && !self.progress.stopped() {
                checkpoints.finished_one(mapper, None, &summary.keyframes);
            }
        }
        Ok(())
    }

    fn process(&self, mapper: &mut Mapper, message: MapperMessage, stop: &dyn Fn() -> bool) -> Result<Processed, PipelineError> {
        let (report, changed) = match message {
            MapperMessage::Points(points) => {
                mapper.add_points(&points, 0)?;
                (None, true)
            }
            MapperMessage::PoseUpdate(updates) => (None, mapper.update_poses(&updates)? > 0),
            MapperMessage::Remove(keyframes) => (None, mapper.remove_keyframes(&keyframes)? > 0),
            MapperMessage::Keyframe(keyframe) => {
                let report = mapper.insert(&keyframe, stop)?;
                (Some(report), report.inserted + report.iterations > 0)
            }
        };
        Ok(Processed { report, changed })
    }

    /// The final refinement, one round at a time, each published; continues the one that a resumed run had begun.
    fn refine(
        &self,
        mapper: &mut Mapper,
        summary: &mut MapSummary,
        begun: Option<FinalRefinement>,
        checkpoints: &mut Checkpoints,
        on_round: &mut dyn FnMut(Round<'_>),
    ) -> Result<(), PipelineError> {
        let mut refinement = begun.map_or_else(|| mapper.begin_refinement(), Ok)?;
        while let Some(report) = mapper.refine(&mut refinement, &|| self.progress.stopped())? {
            tracing::debug!(?report, "refined");
            summary.expose(&mapper.exposures().collect());
            summary.publish(Arc::new(mapper.download()?), report.psnr_db, self.progress);
            on_round(Round { cloud: &summary.cloud, steps: mapper.step_times().len() });
            if !self.progress.stopped() {
                checkpoints.finished_one(mapper, Some(&refinement), &summary.keyframes);
            }
        }
        Ok(())
    }
}

/// The run's checkpointer, if any. A checkpoint that fails does not end the run.
struct Checkpoints {
    checkpointer: Option<Checkpointer>,
    failed: bool,
}

impl Checkpoints {
    fn finished_one(&mut self, mapper: &Mapper, refinement: Option<&FinalRefinement>, records: &[KeyframeRecord]) {
        let Some(checkpointer) = &mut self.checkpointer else { return };
        let began = Instant::now();
        match guarded("mapping", || Ok(checkpointer.finished_one(mapper, refinement, records)?)) {
            Ok(None) => {}
            Ok(Some(bytes)) => tracing::debug!(bytes, ms = began.elapsed().as_secs_f64() * 1e3, "checkpoint written"),
            Err(error) if !self.failed => {
                self.failed = true;
                tracing::warn!("{error}; the run goes on, and the checkpoint before this one stays");
            }
            Err(_) => {}
        }
    }
}

/// Messages of the tracker, in order, with look-ahead.
struct Inbox<'a> {
    messages: &'a Receiver<MapperMessage>,
    /// Taken from the channel to look at: at most one keyframe and the pose updates before it.
    ahead: RefCell<VecDeque<MapperMessage>>,
}

impl Inbox<'_> {
    /// Blocks until the next message; `None` when the tracker has closed the channel.
    fn next(&self) -> Option<MapperMessage> {
        let first = self.ahead.borrow_mut().pop_front();
        first.or_else(|| self.messages.recv().ok())
    }

    fn waiting(&self) -> usize {
        self.ahead.borrow().len() + self.messages.len()
    }

    /// Whether the next keyframe is here, or none will come any more.
    fn keyframe_waits(&self) -> bool {
        let mut ahead = self.ahead.borrow_mut();
        let is_keyframe = |message: &MapperMessage| matches!(message, MapperMessage::Keyframe(_));
        while !ahead.back().is_some_and(is_keyframe) {
            match self.messages.try_recv() {
                Ok(message) => ahead.push_back(message),
                Err(nothing) => return nothing.is_disconnected(),
            }
        }
        true
    }
}

/// Yields the processor while frames wait for the tracker, at most [`LONGEST_PAUSE`]: a tracker that stays behind needs a map all the same.
fn wait_for_tracker(frames: &Receiver<QueuedFrame>) {
    let began = Instant::now();
    while frames.len() > MOST_WAITING && began.elapsed() < LONGEST_PAUSE {
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Effects of one message.
struct Processed {
    report: Option<KeyframeReport>,
    /// Whether the map changed.
    changed: bool,
}

/// Snapshots of the map while the recording lasts: a download waits for the GPU and moves the whole map.
#[derive(Debug, Default)]
struct Snapshots {
    /// Whether the map has changed since the last one.
    is_stale: bool,
    /// When the last one was taken, and how long that took.
    last: Option<(Instant, Duration)>,
}

impl Snapshots {
    /// Time between two snapshots, in units of what one takes.
    const INTERVAL: u32 = 20;

    fn is_due(&self) -> bool {
        self.is_stale && self.last.is_none_or(|(at, cost)| at.elapsed() >= Self::INTERVAL * cost)
    }

    fn take(&mut self, mapper: &Mapper, summary: &mut MapSummary, progress: &Progress) -> Result<(), PipelineError> {
        let began = Instant::now();
        let cloud = Arc::new(mapper.download()?);
        self.last = Some((Instant::now(), began.elapsed()));
        self.is_stale = false;
        let psnr_db = summary.keyframes.last().map_or(0.0, |k| k.report.psnr_db);
        summary.publish(cloud, psnr_db, progress);
        Ok(())
    }

    /// That of the whole map, once no more keyframes come.
    fn last(&mut self, mapper: &Mapper, summary: &mut MapSummary, progress: &Progress) -> Result<(), PipelineError> {
        if self.is_stale { self.take(mapper, summary, progress) } else { Ok(()) }
    }
}

impl MapSummary {
    /// Takes in the exposures of keyframes.
    fn expose(&mut self, exposures: &BTreeMap<KeyframeId, Exposure>) {
        for KeyframeRecord { report, .. } in &mut self.keyframes {
            report.exposure = exposures.get(&report.id).copied().unwrap_or(report.exposure);
        }
    }

    fn publish(&mut self, cloud: Arc<GaussianCloud>, psnr_db: f32, progress: &Progress) {
        self.cloud = cloud.clone();
        progress.mapping.force_push(MapSnapshot { cloud, keyframes: self.keyframes.len(), psnr_db });
    }
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::unbounded;
    use image::RgbImage;

    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::mapping::{DepthSource, Keyframe};
    use crate::sequence::RectifiedImage;

    fn keyframe() -> MapperMessage {
        let pinhole = Pinhole { fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5, width: 8, height: 8 };
        let image = RectifiedImage { pinhole, color: RgbImage::new(8, 8), depth: None, valid: None };
        let world_from_camera = Se3::identity();
        let keyframe = Keyframe { id: 0, world_from_camera, image, depth_source: DepthSource::Sensor, covisible: Vec::new() };
        MapperMessage::Keyframe(Box::new(keyframe))
    }

    /// Real time: the steps of a keyframe end when the next one waits, and pose updates before it are not lost.
    #[test]
    fn a_keyframe_that_waits_is_seen_behind_pose_updates() {
        let (sender, messages) = unbounded();
        let inbox = Inbox { messages: &messages, ahead: RefCell::default() };
        assert!(!inbox.keyframe_waits());
        sender.send(MapperMessage::PoseUpdate(Vec::new())).unwrap();
        assert!(!inbox.keyframe_waits());
        sender.send(keyframe()).unwrap();
        assert!(inbox.keyframe_waits() && inbox.waiting() == 2);
        assert!(matches!(inbox.next(), Some(MapperMessage::PoseUpdate(_))));
        assert!(matches!(inbox.next(), Some(MapperMessage::Keyframe(_))));
        assert!(!inbox.keyframe_waits());
        drop(sender);
        assert!(inbox.keyframe_waits() && inbox.next().is_none());
    }
}
