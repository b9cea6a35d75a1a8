//! The mapping thread: maps keyframes as they arrive, refines the map after the last one, and publishes a snapshot after each.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError};

use super::attending::{Attending, OrderRenderer};
use super::progress::guarded;
use super::read_thread::QueuedFrame;
use super::refining::{Checkpoints, KeptMapper, Refining, Round, figures, step_ms};
use super::{PipelineError, Progress};
use crate::evaluation::machine;
use crate::gpu::Gpu;
use crate::mapping::{
    FinalRefinement, Interlude, KeyframeId, KeyframeReport, Mapper, MapperMessage, MappingConfig, MappingError, PagedOut,
    PagingFigures,
};
use crate::run_folder::{CheckpointError, Checkpointer, KeyframeRecord, RunState};
use crate::splat::{Exposure, GaussianCloud};

/// Real time: the mapper pauses between two batches of steps while more frames than this wait for the tracker,
const MOST_WAITING: usize = 2;
/// but never longer than this.
const LONGEST_PAUSE: Duration = Duration::from_millis(200);
/// Image-only keyframes that may wait for the steps of a keyframe.
const MOST_IMAGES_WAITING: usize = 4;
/// While no message comes, viewers are attended to this often.
const IDLE_LOOK: Duration = Duration::from_millis(50);

/// Result of the mapping thread, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct MapSummary {
    /// The map after the last keyframe that was finished.
    pub cloud: Arc<GaussianCloud>,
    /// Of all but image-only ones.
    pub keyframes: Vec<KeyframeRecord>,
    /// Exposures of image-only keyframes.
    pub images: BTreeMap<KeyframeId, Exposure>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    /// What left the adapter for the disk.
    pub paging: PagingFigures,
    /// Where the refinement may go on.
    pub kept: Option<KeptMapper>,
    /// The thread ended before it reached its checkpoint; there is nothing to write.
    pub behind: bool,
    pub error: Option<PipelineError>,
}

impl MapSummary {
    /// Takes in what the mapper has in the end.
    fn finish(&mut self, mapper: &Mapper, attending: &Attending<'_>) {
        (self.step_ms, self.cloud, self.paging) = (step_ms(mapper), attending.cloud(mapper), mapper.paging());
        self.images = mapper.image_exposures().collect();
        if mapper.has_paged_out() {
            attending.show(&self.cloud);
        }
    }
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
    /// File of Gaussians that leave the GPU; `None` for a temporary one.
    pub chunks: Option<&'a Path>,
}

/// The mapper at the start of the thread's work.
struct Start {
    mapper: Mapper,
    /// What is on the GPU and what is on the disk.
    map: (GaussianCloud, PagedOut),
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
        let Start { mut mapper, map: (cloud, paged_out), refinement, records } = match start {
            Ok(start) => start,
            Err(error) => return MapSummary { behind, error: Some(error), ..MapSummary::default() },
        };
        let mut summary = MapSummary { keyframes: records, ..MapSummary::default() };
        let mut checkpoints = Checkpoints::new(checkpointer);
        let attending = Attending::new(self.progress, Arc::new(cloud), paged_out);
        let mapped = self.map_messages(&mut mapper, &mut summary, &attending, &mut checkpoints);
        summary.error = mapped.err();
        // Also after an error: a device that still answers gives all that was mapped.
        let last = guarded("mapping", || Ok(attending.download(&mapper)?));
        summary.error = summary.error.or(last.err());
        if summary.error.is_none() && mapper.has_not_begun() && !summary.keyframes.is_empty() {
            summary.error = Some(MappingError::NoDepth.into());
        }
        if summary.error.is_none() {
            let refined = self.refine(&mut mapper, &mut summary.keyframes, refinement, &attending, &mut checkpoints, on_round);
            summary.finish(&mapper, &attending);
            match refined {
                Ok(refinement) if self.progress.control().keeps_mapper() => {
                    summary.kept = Some(KeptMapper {
                        mapper,
                        refinement,
                        extra_steps: self.extra_steps(),
                        renderer: OrderRenderer::default(),
                    });
                }
                Ok(_) => {}
                Err(error) => summary.error = Some(error),
            }
            return summary;
        }
        summary.finish(&mapper, &attending);
        summary
    }

    /// The final refinement; continues the one that a resumed run had begun.
    fn refine(
        &self,
        mapper: &mut Mapper,
        records: &mut [KeyframeRecord],
        begun: Option<FinalRefinement>,
        attending: &Attending<'_>,
        checkpoints: &mut Checkpoints,
        on_round: &mut dyn FnMut(Round<'_>),
    ) -> Result<FinalRefinement, PipelineError> {
        let begin = || begun.map_or_else(|| Ok(mapper.begin_refinement()?), Ok);
        let mut refinement = guarded("mapping", begin)?;
        let (progress, extra_steps) = (self.progress, self.extra_steps());
        let refining = Refining { mapper, refinement: &mut refinement, records, attending, progress, extra_steps };
        refining.refine(checkpoints, on_round)?;
        Ok(refinement)
    }

    /// Steps of a round beyond the refinement's end.
    fn extra_steps(&self) -> usize {
        self.config.refine.density_every.max(1)
    }

    /// A new mapper and an empty map, or those of a checkpoint.
    fn start(&self, checkpointer: Option<&mut Checkpointer>) -> Result<Start, PipelineError> {
        if let Some(checkpointer) = checkpointer
            && let Some(state) = checkpointer.take_state()
        {
            return self.catch_up(checkpointer, state);
        }
        let mapper = Mapper::new(self.gpu.clone(), self.config)?.with_chunks(self.chunks.map(Path::to_owned));
        Ok(Start { mapper, map: Default::default(), refinement: None, records: Vec::new() })
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
        let chunks = self.chunks.map(Path::to_owned);
        let mut mapper = Mapper::restore(self.gpu.clone(), self.config, &state.mapper, chunks).map_err(explained)?;
        let records = state.records();
        while checkpointer.digest().messages < state.digest.messages {
            if self.progress.control().is_leaving() {
                self.progress.control().stop();
            }
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
        let map = mapper.download_resident()?;
        Ok(Start { mapper, map, refinement: state.mapper.into_refinement(), records })
    }

    fn map_messages(
        &self,
        mapper: &mut Mapper,
        summary: &mut MapSummary,
        attending: &Attending<'_>,
        checkpoints: &mut Checkpoints,
    ) -> Result<(), PipelineError> {
        let earlier_s = summary.keyframes.last().map_or(0.0, |record| record.done_s);
        let started = Instant::now();
        let inbox = Inbox { messages: self.messages, ahead: RefCell::default() };
        while let Some(message) = inbox.next(|| guarded("mapping", || Ok(attending.attend(mapper)?)))? {
            guarded("mapping", || Ok(attending.while_paused(mapper)?))?;
            let (waiting, began) = (inbox.waiting(), Instant::now());
            let stop = || {
                self.frames.into_iter().for_each(wait_for_tracker);
                self.progress.stopped() || (self.config.yields_to_keyframes && inbox.keyframe_waits())
            };
            checkpoints.received(&message);
            let processed = guarded("mapping", || self.process(mapper, message, &attending.until(&stop)));
            let Processed { report, changed } = processed?;
            tracing::debug!(?report, "message processed");
            let record = |report| KeyframeRecord {
                report,
                done_s: earlier_s + started.elapsed().as_secs_f64(),
                busy_s: began.elapsed().as_secs_f64(),
                waiting,
                host_bytes: machine::host_bytes(),
            };
            summary.keyframes.extend(report.map(record));
            if changed {
                attending.changed();
            }
            if let Some(report) = report {
                attending.publish(figures(mapper, summary.keyframes.len(), report.psnr_db));
                self.progress.control().finished_one();
            }
            guarded("mapping", || Ok(attending.attend(mapper)?))?;
            // A keyframe that was cut short differs from that of an unbroken run.
            if report.is_some() && !self.progress.stopped() {
                checkpoints.finished_one(mapper, None, &summary.keyframes, self.progress.control());
            }
        }
        Ok(())
    }

    fn process(
        &self,
        mapper: &mut Mapper,
        message: MapperMessage,
        interlude: &dyn Interlude,
    ) -> Result<Processed, PipelineError> {
        let (report, changed) = match message {
            MapperMessage::Points(points) => {
                mapper.add_points(&points, 0)?;
                (None, true)
            }
            MapperMessage::Map(map) => {
                mapper.add_map(&map, 0)?;
                (None, true)
            }
            MapperMessage::PoseUpdate(updates) => (None, mapper.update_poses(&updates)? > 0),
            MapperMessage::Remove(keyframes) => (None, mapper.remove_keyframes(&keyframes)? > 0),
            MapperMessage::Keyframe(keyframe) => {
                let report = mapper.insert(&keyframe, interlude)?;
                ((!keyframe.image_only).then_some(report), report.inserted + report.iterations > 0)
            }
        };
        Ok(Processed { report, changed })
    }
}

/// Messages of the tracker, in order, with look-ahead.
struct Inbox<'a> {
    messages: &'a Receiver<MapperMessage>,
    /// Taken from the channel to look at: at most one keyframe, and what came before it.
    ahead: RefCell<VecDeque<MapperMessage>>,
}

impl Inbox<'_> {
    /// Blocks until the next message, and does what comes meanwhile; `None` when the tracker has closed the channel.
    fn next(&self, mut meanwhile: impl FnMut() -> Result<(), PipelineError>) -> Result<Option<MapperMessage>, PipelineError> {
        if let Some(first) = self.ahead.borrow_mut().pop_front() {
            return Ok(Some(first));
        }
        loop {
            match self.messages.recv_timeout(IDLE_LOOK) {
                Ok(message) => return Ok(Some(message)),
                Err(RecvTimeoutError::Disconnected) => return Ok(None),
                Err(RecvTimeoutError::Timeout) => meanwhile()?,
            }
        }
    }

    fn waiting(&self) -> usize {
        self.ahead.borrow().len() + self.messages.len()
    }

    /// Whether the next keyframe is here, or several image-only ones, or none will come any more.
    fn keyframe_waits(&self) -> bool {
        let mut ahead = self.ahead.borrow_mut();
        loop {
            let keyframes =
                || ahead.iter().filter_map(|message| if let MapperMessage::Keyframe(k) = message { Some(k) } else { None });
            if keyframes().any(|k| !k.image_only) || keyframes().count() >= MOST_IMAGES_WAITING {
                return true;
            }
            match self.messages.try_recv() {
                Ok(message) => ahead.push_back(message),
                Err(nothing) => return nothing.is_disconnected(),
            }
        }
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
    /// Of a keyframe that is not image-only.
    report: Option<KeyframeReport>,
    /// Whether the map changed.
    changed: bool,
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::unbounded;
    use image::RgbImage;

    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::mapping::Keyframe;
    use crate::sequence::RectifiedImage;

    fn keyframe(image_only: bool) -> MapperMessage {
        let pinhole = Pinhole { fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5, width: 8, height: 8 };
        let image = RectifiedImage { pinhole, color: RgbImage::new(8, 8), depth: None, valid: None };
        let keyframe = Keyframe { image_only, ..Keyframe::new(0, Se3::identity(), image) };
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
        (1..MOST_IMAGES_WAITING).for_each(|_| sender.send(keyframe(true)).unwrap());
        assert!(!inbox.keyframe_waits());
        sender.send(keyframe(false)).unwrap();
        assert!(inbox.keyframe_waits() && inbox.waiting() == 1 + MOST_IMAGES_WAITING);
        let next = || inbox.next(|| Ok(())).unwrap();
        assert!(matches!(next(), Some(MapperMessage::PoseUpdate(_))));
        (0..MOST_IMAGES_WAITING).for_each(|_| assert!(matches!(next(), Some(MapperMessage::Keyframe(_)))));
        assert!(!inbox.keyframe_waits());
        (0..MOST_IMAGES_WAITING).for_each(|_| sender.send(keyframe(true)).unwrap());
        assert!(inbox.keyframe_waits());
        (0..MOST_IMAGES_WAITING).for_each(|_| drop(next()));
        drop(sender);
        assert!(inbox.keyframe_waits() && next().is_none());
    }
}
