//! Exposures of the keyframes: measured on arrival, and again in the final refinement where photos arrive before there is a map.

use super::{FinalRefinement, Mapper};
use crate::mapping::{ExposureConfig, Keyframe, KeyframeId, MappingError, exposure};
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

    /// Sets the exposure of the newest keyframe, and of those before it that have none of their own.
    pub(super) fn expose(&mut self, keyframe: &Keyframe, survey: Option<&Survey>) -> Exposure {
        let exposure = self.timed("exposure", |mapper| mapper.exposure(&keyframe.image, survey));
        if self.is_measured() {
            self.interpolate_exposures(&exposure);
        }
        if let Some(newest) = self.keyframes.last_mut() {
            newest.exposure = exposure;
        }
        exposure
    }

    /// Whether the newest keyframe's exposure is measured; otherwise it has the last one until the next is.
    pub(super) fn is_measured(&self) -> bool {
        self.keyframes.last().is_some_and(|newest| !newest.image_only)
            || self.unmeasured() + 1 == self.config.exposure.measured_every
    }

    /// Keyframes before the newest one that came since the last measurement.
    fn unmeasured(&self) -> usize {
        self.keyframes.iter().rev().skip(1).take_while(|keyframe| keyframe.image_only).count()
            % self.config.exposure.measured_every
    }

    /// Those since the last measurement get exposures between that and the newest keyframe's, by their frames.
    fn interpolate_exposures(&mut self, newest: &Exposure) {
        let first = (self.keyframes.len() - 1).saturating_sub(self.unmeasured() + 1);
        let [from, between @ .., to] = &mut self.keyframes[first..] else { return };
        for keyframe in between {
            let share = (keyframe.id - from.id) as f32 / (to.id - from.id) as f32;
            keyframe.exposure = from.exposure.towards(newest, share);
        }
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
