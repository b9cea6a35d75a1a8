//! The final refinement, round by round, and going on with it after a run's end.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use super::attending::{Attending, OrderRenderer};
use super::progress::{MappingProgress, guarded};
use super::run::writable;
use super::{Control, PipelineError, Progress};
use crate::mapping::{FinalRefinement, KeyframeId, Mapper, MapperMessage, PagedOut};
use crate::run_folder::{Checkpointer, KeyframeRecord, RunResult};
use crate::splat::{Exposure, GaussianCloud};

/// The map after a round of its refinement.
pub(super) struct Round<'a> {
    mapper: &'a mut Mapper,
    attending: &'a Attending<'a>,
    /// All optimisation steps so far.
    pub steps: usize,
}

impl Round<'_> {
    /// The map; `None` where the device fails, which the next step reports.
    pub fn cloud(&mut self) -> Option<Arc<GaussianCloud>> {
        self.attending.download(self.mapper).ok()?;
        Some(self.attending.cloud(self.mapper))
    }
}

/// The final refinement of a map.
pub(super) struct Refining<'a> {
    pub mapper: &'a mut Mapper,
    pub refinement: &'a mut FinalRefinement,
    /// Records of the mapped keyframes, whose exposures it measures again.
    pub records: &'a mut [KeyframeRecord],
    pub attending: &'a Attending<'a>,
    pub progress: &'a Progress,
    /// Steps of a round beyond the refinement's end.
    pub extra_steps: usize,
}

impl Refining<'_> {
    /// Refines to the end, and on where that is wanted; then downloads the map. `on_round` receives each round, and `checkpoints` writes it.
    ///
    /// # Errors
    /// If the device fails or a step is not finite.
    pub fn refine(mut self, checkpoints: &mut Checkpoints, on_round: &mut dyn FnMut(Round<'_>)) -> Result<(), PipelineError> {
        // After an error the map is that of the last download: the one on the GPU may hold what is not finite.
        guarded("mapping", || self.rounds(checkpoints, on_round))?;
        guarded("mapping", || Ok(self.attending.download(self.mapper)?))
    }

    fn rounds(&mut self, checkpoints: &mut Checkpoints, on_round: &mut dyn FnMut(Round<'_>)) -> Result<(), PipelineError> {
        let Self { mapper, refinement, records, attending, progress, .. } = self;
        loop {
            let stop = || progress.stopped();
            let Some(report) = mapper.refine(refinement, &attending.until(&stop))? else {
                if progress.stopped() || !progress.control().refines_on() || mapper.gaussians() == 0 || records.is_empty() {
                    return Ok(());
                }
                refinement.extend(self.extra_steps);
                continue;
            };
            tracing::debug!(?report, "refined");
            expose(records, &mapper.exposures().collect());
            let figures = figures(mapper, records.len(), report.psnr_db);
            attending.changed();
            attending.publish(MappingProgress { refinement: Some(refinement.steps()), ..figures });
            progress.control().finished_one();
            attending.attend(mapper)?;
            let steps = mapper.step_times().len();
            on_round(Round { mapper, attending, steps });
            if !progress.stopped() {
                checkpoints.finished_one(mapper, Some(refinement), records, progress.control());
            }
        }
    }
}

/// Takes the exposures of keyframes into their records.
fn expose(records: &mut [KeyframeRecord], exposures: &BTreeMap<KeyframeId, Exposure>) {
    for KeyframeRecord { report, .. } in records {
        report.exposure = exposures.get(&report.id).copied().unwrap_or(report.exposure);
    }
}

/// The figures of the map after a keyframe or a round.
pub(super) fn figures(mapper: &Mapper, keyframes: usize, psnr_db: f32) -> MappingProgress {
    let times = mapper.step_times();
    let step_ms = times.last().map_or(0.0, |time| time.as_secs_f64() * 1e3);
    MappingProgress { keyframes, gaussians: mapper.gaussians(), steps: times.len(), psnr_db, step_ms, refinement: None }
}

/// Duration of each step, milliseconds.
pub(super) fn step_ms(mapper: &Mapper) -> Vec<f64> {
    mapper.step_times().iter().map(|t| t.as_secs_f64() * 1e3).collect()
}

/// A mapper that outlives its run, so that the refinement can go on.
#[derive(Debug)]
pub struct KeptMapper {
    pub(super) mapper: Mapper,
    pub(super) refinement: FinalRefinement,
    pub(super) extra_steps: usize,
    pub(super) renderer: OrderRenderer,
}

impl KeptMapper {
    /// Renders the views that are ordered.
    pub fn attend(&mut self, progress: &Progress) {
        while let Some(order) = progress.next_order() {
            self.renderer.answer(&self.mapper, order);
        }
    }

    /// Goes on with the refinement of a finished run until that is switched off or the run is stopped; the result gets the map, its times and
    /// exposures.
    ///
    /// # Errors
    /// If the device fails or a step is not finite; the result has the map before that.
    pub fn refine_on(&mut self, result: &mut RunResult, progress: &Progress) -> Result<(), PipelineError> {
        let started = Instant::now();
        let attending = Attending::new(progress, result.cloud.clone(), PagedOut::default());
        let refining = Refining {
            mapper: &mut self.mapper,
            refinement: &mut self.refinement,
            records: &mut result.history.keyframes,
            attending: &attending,
            progress,
            extra_steps: self.extra_steps,
        };
        let refined = refining.refine(&mut Checkpoints::none(), &mut |_| ());
        result.cloud = writable(attending.cloud(&self.mapper));
        if self.mapper.has_paged_out() {
            attending.show(&result.cloud);
        }
        result.step_ms = step_ms(&self.mapper);
        result.wall_s += started.elapsed().as_secs_f64();
        refined
    }
}

/// The run's checkpointer, if any. A checkpoint that fails does not end the run.
pub(super) struct Checkpoints {
    checkpointer: Option<Checkpointer>,
    failed: bool,
}

impl Checkpoints {
    /// None are written.
    pub fn none() -> Self {
        Self::new(None)
    }

    pub fn new(checkpointer: Option<Checkpointer>) -> Self {
        Self { checkpointer, failed: false }
    }

    /// The mapper has received a message.
    pub fn received(&mut self, message: &MapperMessage) {
        self.checkpointer.iter_mut().for_each(|c| c.received(message));
    }

    /// A keyframe or a round is over. A run that leaves stops here.
    pub fn finished_one(
        &mut self,
        mapper: &mut Mapper,
        refinement: Option<&FinalRefinement>,
        records: &[KeyframeRecord],
        control: &Control,
    ) {
        let leaves = control.is_leaving();
        if leaves {
            control.stop();
        }
        let Some(checkpointer) = &mut self.checkpointer else { return };
        if leaves {
            checkpointer.hurry();
        }
        let began = Instant::now();
        match guarded("mapping", || Ok(checkpointer.finished_one(mapper, refinement, records)?)) {
            Ok(None) => {}
            Ok(Some(bytes)) => {
                mapper.checkpoint_is_written();
                tracing::debug!(bytes, ms = began.elapsed().as_secs_f64() * 1e3, "checkpoint written");
            }
            Err(error) if !self.failed => {
                self.failed = true;
                tracing::warn!("{error}; the run goes on, and the checkpoint before this one stays");
            }
            Err(_) => {}
        }
    }
}
