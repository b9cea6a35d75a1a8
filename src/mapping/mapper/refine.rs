//! Consolidation: steps over all keyframes. Each epoch draws every keyframe with an image once, in a seeded shuffle.
//!
//! Online sessions follow keyframes at constant rates. The final refinement follows the last keyframe: steps at half size first, then at full
//! size, with density control in between; rates fall exponentially, as 3DGS has it for positions.

use serde::{Deserialize, Serialize};

use crate::mapping::{DensityConfig, RefineConfig};
use crate::optimise::{AdamConfig, StepReport};

use super::{BATCH, Mapper, MappingError, Step};

/// Fewer keyframes are all in the window; an online session would repeat its steps.
const FIRST_SESSION: usize = 8;

/// Where a refinement stands; begun by [`Mapper::begin_refinement`].
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FinalRefinement {
    config: RefineConfig,
    /// Rates at the beginning.
    adam: AdamConfig,
    done: usize,
    /// Keyframes left of this epoch.
    epoch: Vec<usize>,
    rounds: usize,
}

/// Result of a refinement round.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RefineReport {
    /// Steps since the beginning of the refinement.
    pub steps_done: usize,
    /// Gaussians removed in this round.
    pub pruned: usize,
    /// Gaussians added by splitting in this round.
    pub grown: usize,
    /// Gaussians in the map afterwards.
    pub gaussians: usize,
    /// Mean PSNR of the round's views before each step.
    pub psnr_db: f32,
}

impl FinalRefinement {
    /// Share of the steps that are done, 0 to 1.
    fn progress(&self) -> f32 {
        self.done as f32 / self.config.steps.max(1) as f32
    }

    /// The rates for the next step.
    fn rates(&self) -> AdamConfig {
        let fallen = |to: f32| to.powf(self.progress());
        self.adam.scaled(fallen(self.config.final_lr_scale_position), fallen(self.config.final_lr_scale))
    }
}

impl Mapper {
    /// Runs an online session if one is due, until `stop`. Returns the number of steps.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub(super) fn consolidate(&mut self, stop: &dyn Fn() -> bool) -> Result<usize, MappingError> {
        let config = self.config.clone();
        let RefineConfig { growth, session_epochs, .. } = config.refine;
        let mut views = self.views();
        let due = ((1.0 + growth) * self.consolidated as f32).max(FIRST_SESSION as f32);
        if growth <= 0.0 || session_epochs == 0 || self.cloud.is_empty() || (views.len() as f32) < due {
            return Ok(0);
        }
        self.consolidated = views.len();
        let mut done = 0;
        for _ in 0..session_epochs {
            self.rng.shuffle(&mut views);
            for batch in views.chunks(BATCH) {
                if stop() {
                    return Ok(done);
                }
                let batch: Vec<Step> = batch.iter().map(|&keyframe| Step { keyframe, coarse: false, lr_scale: 1.0 }).collect();
                done += self.consolidation_steps(&batch, &config.adam)?.len();
            }
        }
        Ok(done)
    }

    /// Keyframes with images, ascending.
    fn views(&self) -> Vec<usize> {
        (0..self.keyframes.len()).filter(|&k| self.keyframes[k].has_image()).collect()
    }

    fn consolidation_steps(&mut self, batch: &[Step], adam: &AdamConfig) -> Result<Vec<StepReport>, MappingError> {
        let sampling = if self.config.refine.all_tiles { None } else { self.tile_sampling() };
        self.steps(batch, None, sampling, adam)
    }

    /// Begins a refinement over the keyframes so far; none may come until it is done.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn begin_refinement(&mut self) -> Result<FinalRefinement, MappingError> {
        let mut config = self.config.refine.clone();
        config.steps = config.steps.max(config.final_epochs * self.views().len());
        Ok(FinalRefinement { adam: self.config.adam.clone(), config, done: 0, epoch: Vec::new(), rounds: 0 })
    }

    /// The steps up to the next density control, and that; `None` when all are done, or `stop` says so.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn refine(
        &mut self,
        refinement: &mut FinalRefinement,
        stop: &dyn Fn() -> bool,
    ) -> Result<Option<RefineReport>, MappingError> {
        let RefineConfig { steps, density_every, growth_share, half_size_share, .. } = refinement.config;
        if refinement.done >= steps || self.cloud.is_empty() || self.keyframes.is_empty() || stop() {
            return Ok(None);
        }
        let density = DensityConfig { views: refinement.config.density_views, ..self.config.density.clone() };
        let density = if refinement.progress() >= growth_share { density.without_growth() } else { density };
        let mut adam = refinement.rates();
        let mut psnr = (0.0, 0);
        let end = steps.min(refinement.done + density_every);
        while refinement.done < end && !stop() {
            let coarse = refinement.progress() < half_size_share;
            let keyframes: Vec<usize> =
                (refinement.done..end.min(refinement.done + BATCH)).map(|_| self.draw_from(refinement)).collect();
            let batch: Vec<Step> = keyframes.into_iter().map(|keyframe| Step { keyframe, coarse, lr_scale: 1.0 }).collect();
            adam = refinement.rates();
            for report in self.consolidation_steps(&batch, &adam)? {
                psnr = (psnr.0 + report.loss.psnr_db(), psnr.1 + 1);
            }
            refinement.done += batch.len();
        }
        let (pruned, grown) = if refinement.done < steps { self.score_and_control(refinement, &density, &adam)? } else { (0, 0) };
        let psnr_db = psnr.0 / psnr.1.max(1) as f32;
        Ok(Some(RefineReport { steps_done: refinement.done, pruned, grown, gaussians: self.cloud.len(), psnr_db }))
    }

    fn draw_from(&mut self, refinement: &mut FinalRefinement) -> usize {
        if refinement.epoch.is_empty() {
            refinement.epoch = self.views();
            self.rng.shuffle(&mut refinement.epoch);
        }
        refinement.epoch.pop().unwrap_or_default()
    }

    /// Density control by views spread over all keyframes, others in each round.
    fn score_and_control(
        &mut self,
        refinement: &mut FinalRefinement,
        density: &DensityConfig,
        adam: &AdamConfig,
    ) -> Result<(usize, usize), MappingError> {
        let mut views = self.views();
        let count = views.len();
        views.rotate_left(refinement.rounds % count);
        refinement.rounds += 1;
        refinement.done += self.score(&views, density, adam)?;
        self.stats.keyframe_mapped();
        self.control_density(density)
    }
}
