//! Exposures of the keyframes: measured on arrival, and again in the final refinement where photos arrive before there is a map.

use super::{FinalRefinement, Mapper};
use crate::mapping::{ExposureConfig, KeyframeId, MappingError, exposure};
use crate::optimise::Survey;
use crate::sequence::RectifiedImage;
use crate::splat::Exposure;

impl Mapper {
    /// Exposures of the keyframes against the map's, in the order of their arrival.
    pub fn exposures(&self) -> impl Iterator<Item = (KeyframeId, Exposure)> {
        self.keyframes.iter().map(|keyframe| (keyframe.id, keyframe.exposure))
    }

    /// Those of the image-only keyframes.
    pub fn image_exposures(&self) -> impl Iterator<Item = (KeyframeId, Exposure)> {
        self.keyframes.iter().filter(|keyframe| keyframe.image_only).map(|keyframe| (keyframe.id, keyframe.exposure))
    }

    /// The exposure of the newest keyframe's image, of which the map shows what was surveyed. A map that no step has moved yet shows nothing that counts.
    pub(super) fn exposure(&self, image: &RectifiedImage, survey: Option<&Survey>) -> Exposure {
        let (config, last) =
            (&self.config.exposure, self.keyframes.iter().nth_back(1).map_or(Exposure::default(), |k| k.exposure));
        let shown = survey.filter(|_| config.enabled && self.is_trained());
        shown.map_or(last, |shown| exposure::measure(exposure::recorded(image), &shown.samples, &last, config))
    }

    /// Measures all exposures if that is due: so many times in the first half of a refinement, at equal distances.
    pub(super) fn refine_exposures(&mut self, refinement: &mut FinalRefinement) -> Result<(), MappingError> {
        let ExposureConfig { enabled, refinements, .. } = self.config.exposure;
        let due = (refinement.exposed + 1) as f32 / (2 * refinements.max(1)) as f32;
        if !enabled || refinement.exposed >= refinements || refinement.progress() < due || !self.chunks.are_here() {
            return Ok(());
        }
        refinement.exposed += 1;
        // The mean becomes the map's exposure, so that nothing has to be given up.
        let config = ExposureConfig { pull: 0.0, ..self.config.exposure.clone() };
        let mut measured = Vec::with_capacity(self.keyframes.len());
        for k in 0..self.keyframes.len() {
            let camera = self.keyframes[k].camera;
            let survey = self.trainer.survey(&self.cloud, &camera, None)?;
            let keyframe = &self.keyframes[k];
            let pixels = keyframe.pixels(&self.gpu, &self.images)?;
            measured.push(exposure::measure(exposure::recorded_pixels(&pixels), &survey.samples, &keyframe.exposure, &config));
        }
        exposure::center(&mut measured);
        self.keyframes.iter_mut().zip(measured).for_each(|(keyframe, exposure)| keyframe.exposure = exposure);
        Ok(())
    }
}
