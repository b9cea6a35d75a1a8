//! Density control: steps that score the Gaussians, and the change that the scores lead to.

use super::{Mapper, Step};
use crate::mapping::density::{self, Candidate};
use crate::mapping::{DensityConfig, DensityStrategy, MappingError};
use crate::optimise::{ErrorPixels, GaussianScore, ScoredMap};

impl Mapper {
    /// Whether, and by what, Gaussians are scored: for control of their density, or to know which to give up.
    pub(super) fn scoring(&self, density: &DensityConfig) -> Option<ErrorPixels> {
        let wanted = density.strategy != DensityStrategy::None || self.is_limited();
        wanted.then(|| density.error_pixels())
    }

    /// Removes and divides Gaussians by the scores of the steps just taken, if any were scored; returns how many fewer and how many more there
    /// are for it.
    pub(super) fn control_density(
        &mut self,
        scored: Option<ScoredMap>,
        density: &DensityConfig,
    ) -> Result<(usize, usize), MappingError> {
        if self.cloud.is_empty() {
            return Ok((0, 0));
        }
        let unscored = || -> Result<ScoredMap, MappingError> {
            let scores = vec![GaussianScore::default(); self.cloud.len()];
            Ok(ScoredMap { scores, geometry: self.cloud.read_geometry(&self.gpu)? })
        };
        let ScoredMap { scores, geometry } = scored.map_or_else(unscored, Ok)?;
        self.stats.scored(&scores);
        let histories = self.stats.histories();
        let candidates: Vec<Candidate> =
            (0..self.cloud.len()).map(|i| Candidate { geometry: geometry[i], score: scores[i], history: histories[i] }).collect();
        let mut plan = density::plan(&candidates, self.most_gaussians(), density);
        if self.probe(plan.len()) {
            plan = density::plan(&candidates, self.most_gaussians(), density);
        }
        let (before, children) = (self.cloud.len(), plan.children.len());
        self.cloud.apply(&self.gpu, &plan)?;
        self.stats.apply(&plan);
        // Two children take their parent's place.
        Ok((before - plan.keep.len() - children / 2, children / 2))
    }

    /// A step of each of some keyframes of the window, evenly spread over it, that scores the Gaussians.
    pub(super) fn scoring_steps(&self, window: &[usize], density: &DensityConfig) -> Vec<Step> {
        let views = density.views.min(window.len());
        let scored = self.scoring(density);
        let step = |k: usize| Step { scored, ..Step::new(window[k * window.len() / views]) };
        (0..scored.map_or(0, |_| views)).map(step).collect()
    }
}
