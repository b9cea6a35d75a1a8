//! Maps keyframes as they come and publishes a snapshot after each.

use std::sync::Arc;

use crossbeam::channel::Receiver;

use super::measurements::Teller;
use super::messages::guarded;
use super::{MapperMessage, PipelineError, Progress};
use crate::gpu::Gpu;
use crate::mapping::{KeyframeReport, Mapper, MappingConfig};
use crate::splat::{GaussianCloud, MapSnapshot};

/// What mapping came to, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct MapSummary {
    /// The map after the last keyframe that was finished.
    pub cloud: Arc<GaussianCloud>,
    pub reports: Vec<KeyframeReport>,
    /// Duration of each optimisation step, milliseconds.
    pub step_ms: Vec<f64>,
    pub error: Option<PipelineError>,
}

/// Maps until the tracker hangs up, or an error.
pub(super) fn map(
    gpu: &Arc<Gpu>,
    config: &MappingConfig,
    messages: &Receiver<MapperMessage>,
    tracker: &Teller,
    progress: &Progress,
) -> MapSummary {
    let mut summary = MapSummary::default();
    let mut mapper = match Mapper::new(gpu.clone(), config) {
        Ok(mapper) => mapper,
        Err(error) => return MapSummary { error: Some(error.into()), ..summary },
    };
    for message in messages {
        let done = guarded("mapping", || match message {
            MapperMessage::PoseUpdate(updates) => {
                let moved = mapper.update_poses(&updates)?;
                Ok(if moved > 0 { Some((None, Arc::new(mapper.download()?))) } else { None })
            }
            MapperMessage::Keyframe(keyframe) => {
                let report = mapper.insert(&keyframe, &|| progress.stopped())?;
                let refined = mapper.refined();
                tracing::trace!(keyframe = keyframe.id, ?refined, "poses refined");
                tracker.tell(keyframe.id, &refined);
                Ok(Some((Some(report), Arc::new(mapper.download()?))))
            }
        });
        match done {
            Ok(None) => {}
            Ok(Some((report, cloud))) => {
                tracing::debug!(?report, "map changed");
                summary.cloud = cloud.clone();
                summary.reports.extend(report);
                let psnr_db = summary.reports.last().map_or(0.0, |r| r.psnr_db);
                progress.mapping.force_push(MapSnapshot { cloud, keyframes: summary.reports.len(), psnr_db });
            }
            Err(error) => {
                summary.error = Some(error);
                break;
            }
        }
    }
    summary.step_ms = mapper.step_times().iter().map(|t| t.as_secs_f64() * 1e3).collect();
    summary
}
