//! What the mapper holds, within its limits and those of the adapter. Where the window itself sees too much, Gaussians of least contribution go
//! first, and so do images of keyframes between near neighbours.

use super::Mapper;
use crate::gpu::GpuError;
use crate::mapping::insertion::{self, Candidates};
use crate::mapping::keyframe::MappedKeyframe;
use crate::mapping::{Keyframe, LimitsConfig, MappingError, limits};
use crate::optimise::Survey;
use crate::render::{GaussianHistory, Plan};
use crate::splat::Exposure;

impl Mapper {
    /// The keyframe with its image on the GPU. Where there is no memory for it, images of earlier ones leave the GPU.
    pub(super) fn upload(&mut self, keyframe: &Keyframe) -> Result<MappedKeyframe, MappingError> {
        loop {
            let uploaded = MappedKeyframe::new(&self.gpu, keyframe, self.config.learns_at_half_size());
            let full = matches!(uploaded, Err(GpuError::OutOfMemory(_)));
            match limits::least_needed_keyframe(&self.keyframes, self.config.window.recent).filter(|_| full) {
                Some(k) => self.keyframes[k].offload(&self.gpu, &mut self.images)?,
                None => return Ok(uploaded?),
            }
        }
    }

    /// Images beyond their number leave the GPU.
    pub(super) fn limit_gpu_images(&mut self) -> Result<(), MappingError> {
        let most = self.config.limits.gpu_images(self.largest_image_bytes());
        let mut resident = self.keyframes.iter().filter(|k| k.is_resident()).count();
        while resident > most
            && let Some(k) = limits::least_needed_keyframe(&self.keyframes, self.config.window.recent)
        {
            self.keyframes[k].offload(&self.gpu, &mut self.images)?;
            resident -= 1;
        }
        Ok(())
    }

    /// Inserts the candidates that the map lacks; returns the number of new Gaussians.
    pub(super) fn insert_gaussians(
        &mut self,
        keyframe: &Keyframe,
        candidates: &Candidates,
        shown: (Option<&Survey>, &Exposure),
    ) -> Result<usize, MappingError> {
        let mut new = insertion::gaussians(keyframe, candidates, shown, &self.config.insertion, self.config.sh_degree);
        self.inserted += new.len();
        let limited = self.config.limits.limits_gaussians();
        if limited {
            self.cloud.limit(self.most_gaussians());
        }
        if self.probe(self.cloud.len() + new.len()) || limited {
            self.make_room(new.len())?;
            let most = self.most_gaussians();
            let others = self.inserted - new.len();
            new = new.thinned(match self.is_trained() {
                true => limits::insertions_allowed(new.len(), most),
                false => limits::sampled(new.len(), others, most + self.chunks.gaussians_away()).min(most),
            });
            self.remove_least(self.cloud.len().saturating_sub(most - new.len()))?;
        }
        let left_out = self.cloud.append(&self.gpu, &new)?;
        self.anchors.append(keyframe.id, new.len() - left_out);
        Ok(new.len())
    }

    /// Removes so many Gaussians: those of least contribution, or evenly spread ones before the first step.
    fn remove_least(&mut self, excess: usize) -> Result<(), MappingError> {
        if excess == 0 {
            return Ok(());
        }
        let frozen = self.cloud.frozen();
        let count = self.cloud.len() - frozen;
        let excess = excess.min(count);
        let mut least = if self.is_trained() {
            let histories: Vec<GaussianHistory> = self.cloud.histories().read(&self.gpu, frozen, count)?;
            let scored_round = self.cloud.rounds() as f32 - self.config.density.every as f32;
            limits::least_contributions(&histories, excess, scored_round)
        } else {
            (0..excess).map(|i| ((2 * i + 1) * count / (2 * excess)) as u32).collect()
        };
        least.iter_mut().for_each(|gaussian| *gaussian += frozen as u32);
        self.change(&Plan::removing(least))
    }

    /// Changes the set of Gaussians.
    pub(super) fn change(&mut self, plan: &Plan) -> Result<(), MappingError> {
        self.cloud.apply(&self.gpu, plan)?;
        self.anchors.apply(plan);
        Ok(())
    }

    /// How many Gaussians there may be on the GPU, at present.
    pub(super) fn most_gaussians(&self) -> usize {
        self.config.limits.gaussians(self.chunks.gaussians_away()).min(self.most_on_gpu())
    }

    /// How many of them its memory has room for, when there is to be room for one more keyframe's image and the growth of a
    /// view's buffers.
    pub(super) fn most_on_gpu(&self) -> usize {
        let kept = self.largest_image_bytes() + self.trainer.growth_bytes();
        let other = LimitsConfig::other_bytes(self.gpu.bytes() + kept, self.cloud.bytes(), self.stepped_capacity);
        self.config.limits.gaussians_on_gpu(self.cloud.bytes_each(), other).min(self.cloud.most(&self.gpu))
    }

    /// Bytes on the GPU of the largest keyframe's image.
    fn largest_image_bytes(&self) -> u64 {
        self.keyframes.iter().map(MappedKeyframe::image_bytes).max().unwrap_or(0)
    }

    /// Whether the number of Gaussians is limited: by the configuration, or because the map fills the adapter.
    pub(super) fn is_limited(&self) -> bool {
        self.config.limits.limits_gaussians() || self.cloud.capacity() >= self.cloud.most(&self.gpu)
    }

    /// Before the map grows to `wanted` Gaussians: whether that is more than the adapter has room for, which is reported once.
    pub(super) fn probe(&mut self, wanted: usize) -> bool {
        self.cloud.probe(&self.gpu, wanted.min(self.most_gaussians()), limits::SCRATCH_BYTES_EACH + limits::LIST_BYTES_EACH);
        let most = self.cloud.most(&self.gpu);
        let full = wanted > most;
        if full && !self.is_full {
            tracing::warn!("the adapter has room for {most} Gaussians; those that no keyframe of the window sees go to the disk");
        }
        self.is_full |= full;
        full
    }
}
