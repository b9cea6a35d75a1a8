//! Maps keyframes as they come, refines the map after the last one, and publishes a snapshot after each.

use std::sync::Arc;
use std::time::Instant;

use crossbeam::channel::Receiver;

use super::measurements::Teller;
use super::messages::guarded;
use super::{KeyframeRecord, MapperMessage, PipelineError, Progress};
use crate::evaluation::machine;
use crate::gpu::Gpu;
use crate::mapping::{KeyframeReport, Mapper, MappingConfig};
use crate::splat::{GaussianCloud, MapSnapshot};

/// What mapping came to, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct MapSummary {
    /// The map after the last keyframe that was finished.
    pub cloud: Arc<GaussianCloud>,
    pub keyframes: Vec<KeyframeRecord>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    pub error: Option<PipelineError>,
}

/// The map after a round of its refinement.
pub(super) struct Round<'a> {
    pub cloud: &'a Arc<GaussianCloud>,
    /// All optimisation steps so far.
    pub steps: usize,
}

/// Maps until the tracker hangs up, then refines; or until an error. `on_round` hears of each round of the refinement.
pub(super) fn map(
    gpu: &Arc<Gpu>,
    config: &MappingConfig,
    messages: &Receiver<MapperMessage>,
    tracker: &Teller,
    (progress, on_round): (&Progress, &mut dyn FnMut(Round<'_>)),
) -> MapSummary {
    let mut summary = MapSummary::default();
    let mut mapper = match Mapper::new(gpu.clone(), config) {
        Ok(mapper) => mapper,
        Err(error) => return MapSummary { error: Some(error.into()), ..summary },
    };
    let started = Instant::now();
    for message in messages.iter() {
        let (waiting, began) = (messages.len(), Instant::now());
        let stop = || progress.stopped() || (config.yields_to_keyframes && !messages.is_empty());
        let done = guarded("mapping", || take(&mut mapper, message, tracker, &stop));
        match done {
            Ok(Taken { report, cloud }) => {
                tracing::debug!(?report, "message taken");
                let record = |report| KeyframeRecord {
                    report,
                    done_s: started.elapsed().as_secs_f64(),
                    busy_s: began.elapsed().as_secs_f64(),
                    waiting,
                    host_bytes: machine::host_bytes(),
                };
                summary.keyframes.extend(report.map(record));
                let psnr_db = summary.keyframes.last().map_or(0.0, |k| k.report.psnr_db);
                summary.publish(cloud, psnr_db, progress);
            }
            Err(error) => {
                summary.error = Some(error);
                break;
            }
        }
    }
    if summary.error.is_none() {
        let refined = guarded("mapping", || refine(&mut mapper, &mut summary, (progress, on_round)));
        summary.error = refined.err();
    }
    summary.step_ms = mapper.step_times().iter().map(|t| t.as_secs_f64() * 1e3).collect();
    summary
}

/// What a message did; the map, if it changed.
struct Taken {
    report: Option<KeyframeReport>,
    cloud: Option<Arc<GaussianCloud>>,
}

fn take(mapper: &mut Mapper, message: MapperMessage, tracker: &Teller, stop: &dyn Fn() -> bool) -> Result<Taken, PipelineError> {
    let (report, changed) = match message {
        MapperMessage::Points(points) => {
            mapper.add_points(&points, 0)?;
            (None, true)
        }
        MapperMessage::PoseUpdate(updates) => (None, mapper.update_poses(&updates)? > 0),
        MapperMessage::Keyframe(keyframe) => {
            let report = mapper.insert(&keyframe, stop)?;
            let refined = mapper.refined();
            tracing::trace!(keyframe = keyframe.id, ?refined, "poses refined");
            tracker.tell(keyframe.id, &refined);
            (Some(report), report.seeded + report.iterations > 0)
        }
    };
    let cloud = if changed { Some(Arc::new(mapper.download()?)) } else { None };
    Ok(Taken { report, cloud })
}

/// The refinement, a round at a time, each published.
fn refine(
    mapper: &mut Mapper,
    summary: &mut MapSummary,
    (progress, on_round): (&Progress, &mut dyn FnMut(Round<'_>)),
) -> Result<(), PipelineError> {
    let mut refinement = mapper.begin_refinement()?;
    while let Some(report) = mapper.refine(&mut refinement, &|| progress.stopped())? {
        tracing::debug!(?report, "refined");
        summary.publish(Some(Arc::new(mapper.download()?)), report.psnr_db, progress);
        on_round(Round { cloud: &summary.cloud, steps: mapper.step_times().len() });
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
