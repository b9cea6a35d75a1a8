//! Consolidation: steps over all keyframes.
//!
//! Online, some follow each keyframe, most of them over keyframes that had few; rates fall with each Gaussian's own steps. The final refinement
//! follows the last keyframe: epochs that draw every keyframe once, in a seeded shuffle, at half size first, then at full size, with density control in between; rates fall
//! exponentially, as 3DGS has it for positions. Where a map of others began the run, they first rise in proportion to the steps (Ma & Yarats 2021):
//! Adam's first steps have the full length whatever the gradient, which a map that is good already does not survive.

use std::ops::ControlFlow;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::mapping::{DensityConfig, MappingError, RefineConfig};
use crate::optimise::AdamConfig;
use crate::splat::model::Dropout;

use super::schedule;
use super::stays::Turns;
use super::steps::Taken;
use super::{BATCH, Interlude, Mapper, Step};

/// Share of the steps after which nothing is pruned: neighbours take some epochs to fill the place of a Gaussian.
const LAST_CONTROL: f32 = 0.8;
/// Steps in which the rates of a map of others rise: half of those that the second moments remember.
const WARM_UP_STEPS: usize = 500;

/// Where a refinement stands; begun by [`Mapper::begin_refinement`].
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FinalRefinement {
    config: RefineConfig,
    /// Rates at the beginning.
    adam: AdamConfig,
    done: usize,
    /// Steps beyond the configured ones that were asked for since.
    #[serde(skip)]
    more: usize,
    rounds: usize,
    /// Steps in which the rates rise; none where points or keyframes began the map.
    warm_up: usize,
    /// Measurements of the exposures so far.
    pub(super) exposed: usize,
    /// A refinement of so many seconds has no checkpoint.
    #[serde(skip)]
    started: Option<Instant>,
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
    /// Share of the steps, or of the time, that is spent; 1 at the end.
    pub(super) fn progress(&self) -> f32 {
        match (self.config.seconds, self.started) {
            (Some(seconds), Some(started)) => (started.elapsed().as_secs_f64() / seconds.max(f64::MIN_POSITIVE)).min(1.0) as f32,
            _ if self.config.steps == 0 => 1.0,
            _ => (self.done as f32 / self.config.steps as f32).min(1.0),
        }
    }

    fn is_done(&self) -> bool {
        self.progress() >= 1.0 && self.more == 0
    }

    /// An interlude, whose time is none of the refinement's seconds.
    fn interlude(&mut self, mapper: &Mapper, interlude: &dyn Interlude) -> Result<ControlFlow<()>, MappingError> {
        let began = Instant::now();
        let flow = interlude.between(mapper)?;
        self.started = self.started.map(|started| started + began.elapsed());
        Ok(flow)
    }

    /// Nothing is left to learn from.
    fn end_here(&mut self) {
        (self.config.seconds, self.config.steps, self.more) = (None, self.done, 0);
    }

    /// Goes on beyond its end for so many steps, at the last rates and without density control.
    pub fn extend(&mut self, steps: usize) {
        self.more += steps;
    }

    /// Steps taken, and those of the whole refinement; unknown where seconds bound it.
    pub fn steps(&self) -> (usize, Option<usize>) {
        let planned = self.config.seconds.is_none().then_some(self.config.steps);
        (self.done, planned.map(|steps| steps.max(self.done + self.more)))
    }

    /// The rates at a share of the steps.
    fn rates(&self, progress: f32) -> AdamConfig {
        let risen = if self.done < self.warm_up { (self.done + 1) as f32 / self.warm_up as f32 } else { 1.0 };
        let fallen = |to: f32| risen * to.powf(progress);
        self.adam.scaled(fallen(self.config.final_lr_scale_position), fallen(self.config.final_lr_scale))
    }
}

impl Mapper {
    /// Steps over the window, and the online steps over all keyframes that follow them.
    pub(super) fn with_consolidation(&mut self, mut steps: Vec<Step>) -> Vec<Step> {
        if !self.config.yields_to_keyframes {
            steps.extend(self.draw_online(self.config.refine.steps_per_keyframe, &steps));
        }
        steps
    }

    /// Takes steps over all keyframes until `interlude` ends them.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub(super) fn consolidate_until(&mut self, interlude: &dyn Interlude) -> Result<Taken, MappingError> {
        let adam = self.config.adam.online();
        let mut taken = Taken::default();
        while !self.cloud.is_empty() && interlude.between(self)?.is_continue() {
            let batch = self.draw_online(self.batch(), &[]);
            if batch.is_empty() {
                break;
            }
            taken += self.steps(&batch, &adam, None)?.0;
        }
        Ok(taken)
    }

    /// So many steps over all keyframes, most over those that had fewest, `planned` ones included.
    fn draw_online(&mut self, count: usize, planned: &[Step]) -> Vec<Step> {
        let learnable = self.learnable(0..self.keyframes.len());
        let keyframes = &self.keyframes;
        let taken = |k: usize| keyframes[k].steps + planned.iter().filter(|step| step.keyframe == k).count() as u32;
        schedule::draw_least_learnt(&learnable, taken, count, &mut self.rng).into_iter().map(Step::new).collect()
    }

    /// So many steps of the running epoch; `left` is how many the refinement has left.
    fn draw_from_epoch(&mut self, count: usize, left: usize, coarse: bool) -> Result<Vec<Step>, MappingError> {
        let mut steps = Vec::with_capacity(count);
        while steps.len() < count {
            if self.epoch.is_empty() {
                if self.is_staying() && !steps.is_empty() {
                    // Their Gaussians may leave for the next stay.
                    break;
                }
                self.epoch = self.next_epoch(left.saturating_sub(steps.len()))?;
            }
            let Some(keyframe) = self.epoch.pop() else { break };
            // Chunks may have left since the epoch began.
            if self.is_learnable(keyframe) {
                steps.push(Step { coarse, ..Step::new(keyframe) });
            }
        }
        Ok(steps)
    }

    /// Keyframes in the order in which steps learn from them, the last first.
    fn next_epoch(&mut self, left: usize) -> Result<Vec<usize>, MappingError> {
        if self.is_staying() {
            return self.next_stay(left);
        }
        self.turns.end_stay();
        let mut epoch = self.learnable(self.views());
        self.rng.shuffle(&mut epoch);
        Ok(epoch)
    }

    /// Whether epochs are stays with what the GPU has room for.
    fn is_staying(&self) -> bool {
        self.turns.have_begun() && !self.chunks.are_here()
    }

    /// Share of the steps that Gaussians on the GPU have had, as rates and density control take it.
    fn progress(&self, refinement: &FinalRefinement) -> f32 {
        self.turns.progress(self.epoch.len()).unwrap_or_else(|| refinement.progress())
    }

    /// Lets each step leave out a share of the Gaussians, others each time.
    fn drop_out(&mut self, steps: &mut [Step], share: f32) {
        if share > 0.0 {
            steps.iter_mut().for_each(|step| step.dropout = Dropout { share, seed: self.rng.u32(..) });
        }
    }

    /// All keyframes, ascending.
    fn views(&self) -> Vec<usize> {
        (0..self.keyframes.len()).collect()
    }

    /// Begins a refinement, and with it an epoch, over the keyframes so far; none may come until it is done.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn begin_refinement(&mut self) -> Result<FinalRefinement, MappingError> {
        let mut config = self.config.refine.clone();
        config.steps = match config.seconds {
            Some(_) => usize::MAX,
            None => config.steps.max(config.final_epochs * self.full_keyframes()),
        };
        let started = config.seconds.map(|_| Instant::now());
        // Each Gaussian's own views get their turn.
        self.fix(&[])?;
        self.epoch.clear();
        self.turns = Turns::new(self.keyframes.len(), config.seconds.is_none().then_some(config.steps));
        let mut warm_up = 0;
        if self.has_initial_map {
            // It has the detail that steps at half size would take from it.
            (warm_up, config.half_size_share) = (WARM_UP_STEPS, 0.0);
        }
        Ok(FinalRefinement { adam: self.config.adam.clone(), config, done: 0, more: 0, rounds: 0, warm_up, exposed: 0, started })
    }

    /// The steps up to the next density control, and that; `None` when all are done, or `interlude` ends them.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn refine(
        &mut self,
        refinement: &mut FinalRefinement,
        interlude: &dyn Interlude,
    ) -> Result<Option<RefineReport>, MappingError> {
        let RefineConfig { steps, density_every, growth_share, half_size_share, .. } = refinement.config;
        let is_over = refinement.is_done() || self.cloud.is_empty() || self.keyframes.is_empty();
        if is_over || refinement.interlude(self, interlude)?.is_break() {
            return Ok(None);
        }
        let density = DensityConfig { views: refinement.config.density_views, ..self.config.density.clone() };
        let density = if self.progress(refinement) >= growth_share { density.without_growth() } else { density };
        let mut adam = refinement.rates(self.progress(refinement));
        let mut taken = Taken::default();
        let is_extra = refinement.progress() >= 1.0;
        let left = |refinement: &FinalRefinement| if is_extra { refinement.more } else { steps - refinement.done };
        let end = refinement.done + density_every.min(left(refinement));
        while refinement.done < end && !refinement.is_done() && refinement.interlude(self, interlude)?.is_continue() {
            let coarse = self.progress(refinement) < half_size_share;
            let mut batch = self.draw_from_epoch(BATCH.min(end - refinement.done), left(refinement), coarse)?;
            if batch.is_empty() {
                refinement.end_here();
                break;
            }
            let progress = self.progress(refinement);
            self.drop_out(&mut batch, refinement.config.dropout * progress);
            batch.iter_mut().for_each(|step| step.surface_share = progress);
            adam = refinement.rates(progress);
            taken += self.steps(&batch, &adam, None)?.0;
            refinement.done += batch.len();
            if is_extra {
                refinement.more = refinement.more.saturating_sub(batch.len());
            }
        }
        self.refine_exposures(refinement)?;
        let is_controlled = self.progress(refinement) < LAST_CONTROL;
        let (pruned, grown) = if is_controlled { self.score_and_control(refinement, &density, &adam)? } else { (0, 0) };
        let (gaussians, psnr_db) = (self.gaussians(), taken.psnr_db());
        Ok(Some(RefineReport { steps_done: refinement.done, pruned, grown, gaussians, psnr_db }))
    }

    /// Density control by views spread over all keyframes, others in each round.
    fn score_and_control(
        &mut self,
        refinement: &mut FinalRefinement,
        density: &DensityConfig,
        adam: &AdamConfig,
    ) -> Result<(usize, usize), MappingError> {
        let mut views = self.learnable(self.views());
        let count = views.len();
        views.rotate_left(refinement.rounds % count.max(1));
        refinement.rounds += 1;
        let steps = self.scoring_steps(&views, density);
        self.trainer.begin_scores(&self.cloud)?;
        self.cloud.begin_round();
        let (taken, verdicts) = self.take_scored(&steps, adam, density)?;
        refinement.done += taken.steps;
        self.control_density(verdicts, density)
    }
}
