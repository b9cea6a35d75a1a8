//! Steps, a batch at a time, and the scores that come with some of them.

use std::borrow::Cow;
use std::time::Instant;

use super::{Interlude, KEYFRAME_BATCH, Mapper, Step, YIELDING_BATCH};
use crate::mapping::chunks::Hidden;
use crate::mapping::image_store::ImageStore;
use crate::mapping::keyframe::MappedKeyframe;
use crate::mapping::{DensityConfig, MappingError};
use crate::optimise::{AdamConfig, OverScores, Pixels, TrainingView};
use crate::render::HIDDEN;

impl Mapper {
    /// Takes steps, in batches, until `interlude` ends them.
    pub(super) fn take(&mut self, steps: &[Step], adam: &AdamConfig, interlude: &dyn Interlude) -> Result<Taken, MappingError> {
        let mut taken = Taken::default();
        for batch in steps.chunks(self.batch()) {
            if interlude.between(self)?.is_break() {
                break;
            }
            taken += self.timed("steps", |mapper| mapper.steps(batch, adam, None))?.0;
        }
        Ok(taken)
    }

    /// Takes steps, in batches, and returns with them the verdicts of density control after the last one, `[N]`; none without steps.
    pub(super) fn take_scored(
        &mut self,
        steps: &[Step],
        adam: &AdamConfig,
        density: &DensityConfig,
    ) -> Result<(Taken, Vec<u32>), MappingError> {
        let (mut taken, mut verdicts) = (Taken::default(), Vec::new());
        let mut batches = steps.chunks(self.batch()).peekable();
        while let Some(batch) = batches.next() {
            let judged = batches.peek().is_none().then_some(density);
            let (more, read) = self.timed("steps", |mapper| mapper.steps(batch, adam, judged))?;
            taken += more;
            verdicts = read;
        }
        Ok((taken, verdicts))
    }

    /// Steps after a keyframe that are submitted at once.
    pub(super) fn batch(&self) -> usize {
        if self.config.yields_to_keyframes { YIELDING_BATCH } else { KEYFRAME_BATCH }
    }

    /// Takes a batch of steps; returns with them the verdicts of density control, if wanted.
    pub(super) fn steps(
        &mut self,
        batch: &[Step],
        adam: &AdamConfig,
        judged: Option<&DensityConfig>,
    ) -> Result<(Taken, Vec<u32>), MappingError> {
        let hidden: Vec<Option<Hidden>> = batch.iter().map(|step| self.hidden(step.keyframe)).collect();
        for (step, _) in batch.iter().zip(&hidden).filter(|(_, hidden)| hidden.is_some()) {
            self.keyframes[step.keyframe].offload(&self.gpu, &mut self.images)?;
        }
        // In the final refinement, what reaches into them is taught by its own views in their turn.
        let mark = if self.turns.have_begun() { 0 } else { HIDDEN };
        let streamed = batch
            .iter()
            .zip(hidden)
            .map(|(step, hidden)| streamed(&self.keyframes[step.keyframe], step.coarse, (hidden, mark), &self.images));
        let streamed = streamed.collect::<std::io::Result<Vec<_>>>()?;
        let views = batch.iter().zip(&streamed).map(|(step, pixels)| {
            let keyframe = &self.keyframes[step.keyframe];
            let view = keyframe.view(step.coarse);
            let depth_confidence = if keyframe.depth_is_estimated() { self.config.plane_sweep.depth_confidence } else { 1.0 };
            let Step { scored, dropout, surface_share, .. } = *step;
            TrainingView { streamed: pixels.as_deref(), depth_confidence, scored, dropout, surface_share, ..view }
        });
        let views: Vec<TrainingView<'_>> = views.collect();
        let started = Instant::now();
        if let Some(density) = judged {
            self.density.prepare(&self.gpu, &density.setup(&self.map_size()))?;
        }
        self.stepped_capacity = self.cloud.capacity();
        let judge = judged.map(|_| self.density.verdicts(&self.gpu, &self.cloud));
        let then = judge.as_ref().map(|judge| judge as &dyn OverScores);
        let (reports, verdicts) = self.trainer.steps_and_then(&self.cloud, &views, (&self.config.loss, adam), then)?;
        self.step_times.extend(std::iter::repeat_n(started.elapsed() / batch.len().max(1) as u32, batch.len()));
        batch.iter().for_each(|step| self.keyframes[step.keyframe].steps += 1);
        let mut taken = Taken { steps: batch.len(), psnr_sum: 0.0 };
        for (step, report) in batch.iter().zip(&reports) {
            if !report.loss.total(&self.config.loss).is_finite() {
                return Err(MappingError::NotFinite { id: self.keyframes[step.keyframe].id });
            }
            taken.psnr_sum += report.loss.psnr_db();
        }
        Ok((taken, verdicts))
    }
}

/// Pixels of a view whose image is not on the GPU, without those in which something is hidden.
fn streamed<'a>(
    keyframe: &'a MappedKeyframe,
    coarse: bool,
    (hidden, mark): (Option<Hidden>, u32),
    images: &ImageStore,
) -> std::io::Result<Option<Cow<'a, Pixels>>> {
    let mut pixels = keyframe.streamed(coarse, images)?;
    if let (Some(pixels), Some(hidden)) = (&mut pixels, hidden) {
        let width = keyframe.view(coarse).camera.pinhole.width;
        hidden.leave_out(pixels.to_mut(), width, width < keyframe.camera.pinhole.width, mark);
    }
    Ok(pixels)
}

/// Steps taken.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Taken {
    pub steps: usize,
    /// Of the PSNR of each step's view before it.
    psnr_sum: f32,
}

impl Taken {
    pub fn psnr_db(&self) -> f32 {
        self.psnr_sum / self.steps.max(1) as f32
    }
}

impl std::ops::AddAssign for Taken {
    fn add_assign(&mut self, more: Self) {
        self.steps += more.steps;
        self.psnr_sum += more.psnr_sum;
    }
}
