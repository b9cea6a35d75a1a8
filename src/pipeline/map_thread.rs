//! Maps keyframes as they come, refines the map after the last one, and publishes a snapshot after each.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::Receiver;

use super::keeper::{Checkpoints, Resumed};
use super::measurements::Teller;
use super::messages::guarded;
use super::{KeyframeRecord, MapperMessage, PipelineError, Progress};
use crate::evaluation::machine;
use crate::gpu::Gpu;
use crate::mapping::{KeyframeReport, Mapper, MappingConfig, MappingError, RefinedPair, Refinement};
use crate::sequence::Frame;
use crate::splat::{GaussianCloud, MapSnapshot};

/// Paced replay: the mapper pauses between two batches of steps while more frames than this wait for the tracker,
const MOST_WAITING: usize = 2;
/// but never longer than this.
const LONGEST_PAUSE: Duration = Duration::from_millis(200);

/// What mapping came to, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct MapSummary {
    /// The map after the last keyframe that was finished.
    pub cloud: Arc<GaussianCloud>,
    pub keyframes: Vec<KeyframeRecord>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    /// It did not come as far as the checkpoint that it was to go on from, and there is nothing to write.
    pub behind: bool,
    pub error: Option<PipelineError>,
}

/// The map after a round of its refinement.
pub(super) struct Round<'a> {
    pub cloud: &'a Arc<GaussianCloud>,
    /// All optimisation steps so far.
    pub steps: usize,
}

/// Maps until the tracker hangs up, then refines; or until an error. `on_round` hears of each round of the refinement. With checkpoints, it
/// goes on from the one that there is, and keeps more. `frames`, those that wait for the tracker, are given where they must not wait long.
pub(super) fn map(
    gpu: &Arc<Gpu>,
    config: &MappingConfig,
    (messages, frames): (&Receiver<MapperMessage>, Option<&Receiver<Frame>>),
    tracker: &Teller,
    (progress, on_round): (&Progress, &mut dyn FnMut(Round<'_>)),
    mut checkpoints: Option<Checkpoints>,
) -> MapSummary {
    let behind = checkpoints.as_ref().is_some_and(Checkpoints::is_behind);
    let begun = guarded("mapping", || begin(gpu, config, (messages, tracker), checkpoints.as_mut()));
    let (Resumed { mut mapper, refinement, records }, cloud) = match begun {
        Ok(begun) => begun,
        Err(error) => return MapSummary { behind, error: Some(error), ..MapSummary::default() },
    };
    let earlier_s = records.last().map_or(0.0, |record| record.done_s);
    let mut summary = MapSummary { cloud, keyframes: records, ..MapSummary::default() };
    let started = Instant::now();
    let inbox = Inbox { messages, ahead: RefCell::default() };
    while let Some(message) = inbox.next() {
        let (waiting, began) = (inbox.waiting(), Instant::now());
        let stop = || {
            frames.into_iter().for_each(let_catch_up);
            progress.stopped() || (config.yields_to_keyframes && inbox.keyframe_waits())
        };
        checkpoints.iter_mut().for_each(|c| c.hear(&message));
        let done = guarded("mapping", || take(&mut mapper, message, tracker, &stop));
        match done {
            Ok(Taken { report, refined, cloud }) => {
                tracing::debug!(?report, "message taken");
                let record = |report| KeyframeRecord {
                    report,
                    done_s: earlier_s + started.elapsed().as_secs_f64(),
                    busy_s: began.elapsed().as_secs_f64(),
                    waiting,
                    host_bytes: machine::host_bytes(),
                };
                summary.keyframes.extend(report.map(record));
                let psnr_db = summary.keyframes.last().map_or(0.0, |k| k.report.psnr_db);
                summary.publish(cloud, psnr_db, progress);
                // A keyframe that was cut short is not as it would have been.
                if let Some(checkpoints) = checkpoints.as_mut().filter(|_| report.is_some() && !progress.stopped()) {
                    checkpoints.tell(refined);
                    checkpoints.done(&mapper, None, &summary.keyframes);
                }
            }
            Err(error) => {
                summary.error = Some(error);
                break;
            }
        }
    }
    if summary.error.is_none() && mapper.has_not_begun() && !summary.keyframes.is_empty() {
        summary.error = Some(MappingError::NoDepth.into());
    }
    if summary.error.is_none() {
        let begun = (refinement, checkpoints.as_mut());
        let refined = guarded("mapping", || refine(&mut mapper, &mut summary, begun, (progress, on_round)));
        summary.error = refined.err();
    }
    summary.step_ms = mapper.step_times().iter().map(|t| t.as_secs_f64() * 1e3).collect();
    summary
}

/// What the tracker sent, in its order, of which the mapper may look ahead.
struct Inbox<'a> {
    messages: &'a Receiver<MapperMessage>,
    /// Taken from the channel to look at: at most one keyframe and the pose updates before it.
    ahead: RefCell<VecDeque<MapperMessage>>,
}

impl Inbox<'_> {
    /// Waits for the next one; `None` when the tracker has hung up.
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

/// Leaves the machine to the tracker while frames wait for it; not for long, for a tracker that never catches up needs a map all the same.
fn let_catch_up(frames: &Receiver<Frame>) {
    let began = Instant::now();
    while frames.len() > MOST_WAITING && began.elapsed() < LONGEST_PAUSE {
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The mapper to begin with, and its map: a new one, or that of a checkpoint.
fn begin(
    gpu: &Arc<Gpu>,
    config: &MappingConfig,
    channels: (&Receiver<MapperMessage>, &Teller),
    checkpoints: Option<&mut Checkpoints>,
) -> Result<(Resumed, Arc<GaussianCloud>), PipelineError> {
    match checkpoints.map(|c| c.catch_up(gpu, config, channels)).transpose()?.flatten() {
        Some(resumed) => {
            let cloud = Arc::new(resumed.mapper.download()?);
            Ok((resumed, cloud))
        }
        None => {
            let mapper = Mapper::new(gpu.clone(), config)?;
            Ok((Resumed { mapper, refinement: None, records: Vec::new() }, Arc::default()))
        }
    }
}

/// What a message did; the map, if it changed.
struct Taken {
    report: Option<KeyframeReport>,
    /// What the tracker was told of the keyframe.
    refined: Vec<RefinedPair>,
    cloud: Option<Arc<GaussianCloud>>,
}

fn take(mapper: &mut Mapper, message: MapperMessage, tracker: &Teller, stop: &dyn Fn() -> bool) -> Result<Taken, PipelineError> {
    let (report, refined, changed) = match message {
        MapperMessage::Points(points) => {
            mapper.add_points(&points, 0)?;
            (None, Vec::new(), true)
        }
        MapperMessage::PoseUpdate(updates) => (None, Vec::new(), mapper.update_poses(&updates)? > 0),
        MapperMessage::Keyframe(keyframe) => {
            let report = mapper.insert(&keyframe, stop)?;
            let refined = mapper.refined();
            tracing::trace!(keyframe = keyframe.id, ?refined, "poses refined");
            tracker.tell(keyframe.id, &refined);
            (Some(report), refined, report.seeded + report.iterations > 0)
        }
    };
    let cloud = if changed { Some(Arc::new(mapper.download()?)) } else { None };
    Ok(Taken { report, refined, cloud })
}

/// The refinement, a round at a time, each published; it goes on where it stood, if it had begun.
fn refine(
    mapper: &mut Mapper,
    summary: &mut MapSummary,
    (begun, mut checkpoints): (Option<Refinement>, Option<&mut Checkpoints>),
    (progress, on_round): (&Progress, &mut dyn FnMut(Round<'_>)),
) -> Result<(), PipelineError> {
    let first = mapper.begin_refinement()?;
    let mut refinement = begun.unwrap_or(first);
    while let Some(report) = mapper.refine(&mut refinement, &|| progress.stopped())? {
        tracing::debug!(?report, "refined");
        summary.publish(Some(Arc::new(mapper.download()?)), report.psnr_db, progress);
        on_round(Round { cloud: &summary.cloud, steps: mapper.step_times().len() });
        if let Some(checkpoints) = checkpoints.as_mut().filter(|_| !progress.stopped()) {
            checkpoints.done(mapper, Some(&refinement), &summary.keyframes);
        }
    }
    Ok(())
}

impl MapSummary {
    fn publish(&mut self, changed: Option<Arc<GaussianCloud>>, psnr_db: f32, progress: &Progress) {
        let Some(cloud) = changed else { return };
        self.cloud = cloud.clone();
        progress.mapping.force_push(MapSnapshot { cloud, keyframes: self.keyframes.len(), psnr_db });
    }
}
