//! Density control: steps that score the Gaussians, and the change that the scores lead to.

use super::{Mapper, Step};
use crate::mapping::density::{self, MapSize};
use crate::mapping::{DensityConfig, DensityStrategy, MappingError};
use crate::optimise::ErrorPixels;
use crate::render::layout::VERDICT_KEEP;

impl Mapper {
    /// Whether, and by what, Gaussians are scored: for control of their density, or to know which to give up.
    pub(super) fn scoring(&self, density: &DensityConfig) -> Option<ErrorPixels> {
        let wanted = density.strategy != DensityStrategy::None || self.is_limited();
        wanted.then(|| density.error_pixels())
    }

    /// Removes and divides Gaussians by the verdicts after the steps just taken; without any, by those on the map as it is. Returns how many
    /// fewer and how many more there are for it.
    pub(super) fn control_density(
        &mut self,
        mut verdicts: Vec<u32>,
        density: &DensityConfig,
    ) -> Result<(usize, usize), MappingError> {
        if self.cloud.is_empty() {
            return Ok((0, 0));
        }
        if verdicts.is_empty() {
            self.density.prepare(&self.gpu, &density.setup(&self.map_size()))?;
            verdicts = self.trainer.over_scores(&self.density.verdicts(&self.gpu, &self.cloud))?;
        }
        // What is frozen or fixed neither goes nor is divided.
        let frozen = self.cloud.frozen();
        verdicts[..frozen].fill(VERDICT_KEEP);
        self.anchors.fixed().for_each(|place| verdicts[place as usize] = VERDICT_KEEP);
        self.density.remember(&self.gpu, &self.cloud, self.trainer.scores());
        let before = self.cloud.len();
        let mut plan = density::plan(&verdicts, self.most_gaussians(), density);
        if self.probe(plan.len_after(before)) {
            plan = density::plan(&verdicts, self.most_gaussians(), density);
        }
        self.change(&plan)?;
        // Two children take their parent's place.
        let grown = plan.divided.len();
        Ok((plan.removed.len() - grown, grown))
    }

    /// The map's size, as the rules of density control need it.
    pub(super) fn map_size(&self) -> MapSize {
        MapSize { count: self.cloud.len(), capacity: self.cloud.capacity(), rounds: self.cloud.rounds() }
    }

    /// A step of each of some keyframes of the window, evenly spread over it, that scores the Gaussians.
    pub(super) fn scoring_steps(&self, window: &[usize], density: &DensityConfig) -> Vec<Step> {
        let views = density.views.min(window.len());
        let scored = self.scoring(density);
        let step = |k: usize| Step { scored, ..Step::new(window[k * window.len() / views]) };
        (0..scored.map_or(0, |_| views)).map(step).collect()
    }
}
