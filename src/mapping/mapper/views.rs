//! What steps learn from while a part of the map is away. A view leaves out the pixels in which something is seen that is away. Gaussians of which the
//! views say too little are rendered, and stay as they are: steps from others would spoil what their own views taught.

use rayon::prelude::*;

use super::Mapper;
use super::paging::Group;
use crate::mapping::MappingError;
use crate::mapping::chunks::{Hidden, Outlook};

/// Share of an image that steps learn from at least.
const LEAST_SEEN: f32 = 0.5;
/// Share of the keyframes near by that see a Gaussian from which steps can learn, at least, where the Gaussian is to be moved.
const LEAST_LEARNABLE: f32 = 0.75;
/// Keyframes near by that are looked at, so that the work for a keyframe does not grow with the map; image-only ones between them come on top.
const NEAR: usize = 256;

impl Mapper {
    /// Keyframes of these that steps can learn from.
    pub(super) fn learnable(&self, keyframes: impl IntoIterator<Item = usize>) -> Vec<usize> {
        keyframes.into_iter().filter(|k| self.is_learnable(*k)).collect()
    }

    /// Whether all is here that most of the image shows.
    pub(super) fn is_learnable(&self, k: usize) -> bool {
        self.chunks.are_here() || self.learnable.binary_search(&k).is_ok()
    }

    /// Where the keyframe sees something that is away.
    pub(super) fn hidden(&self, k: usize) -> Option<Hidden> {
        self.chunks.hidden_from(&self.keyframes[k].outlook())
    }

    /// The keyframes nearest to this one, itself first: [`NEAR`], and the image-only ones that are no farther.
    pub(super) fn keyframes_near(&self, k: usize) -> Vec<usize> {
        let here = self.keyframes[k].position();
        let distance = |keyframe: usize| (self.keyframes[keyframe].position() - here).norm_squared();
        let mut near: Vec<(f64, usize)> = (0..self.keyframes.len()).map(|k| (distance(k), k)).collect();
        let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        let mut full: Vec<(f64, usize)> = near.iter().copied().filter(|(_, k)| !self.keyframes[*k].image_only).collect();
        if full.len() > NEAR {
            let (_, beyond, _) = full.select_nth_unstable_by(NEAR, order);
            near.retain(|keyframe| order(keyframe, beyond).is_lt());
        }
        near.sort_unstable_by(order);
        near.into_iter().map(|(_, k)| k).collect()
    }

    /// Finds the keyframes that steps can learn from, after Gaussians have come or left: among the needing ones, and those near the first of these.
    pub(super) fn find_learnable(&mut self) {
        let Some(first) = self.needing.first() else { return };
        let mut near = self.keyframes_near(*first);
        near.extend(&self.needing);
        near.sort_unstable();
        near.dedup();
        let (keyframes, chunks) = (&self.keyframes, &self.chunks);
        let is_learnable = |k: &usize| chunks.is_here(&keyframes[*k].outlook(), LEAST_SEEN);
        self.learnable = near.into_par_iter().filter(is_learnable).collect();
    }

    /// Fixes the Gaussians on the GPU that steps would spoil: all but those of the window's keyframes, and those whose own keyframe can be learnt from and
    /// most of those near by that see them.
    pub(super) fn fix_context(&mut self) -> Result<(), MappingError> {
        if self.chunks.are_here() {
            return self.fix(&[]);
        }
        self.find_learnable();
        let mut near = self.keyframes_near(self.needing[0]);
        near.extend(self.learnable.iter().copied().filter(|k| !near.contains(k)).collect::<Vec<_>>());
        let views: Vec<(bool, Outlook<'_>)> =
            near.iter().map(|k| (self.is_learnable(*k), self.keyframes[*k].outlook())).collect();
        let is_context = |group: &Group| {
            let seeing: Vec<bool> = views.iter().filter(|(_, outlook)| outlook.sees(&group.ball)).map(|(is, _)| *is).collect();
            let learnable = seeing.iter().filter(|is_learnable| **is_learnable).count();
            (learnable as f32) < LEAST_LEARNABLE * seeing.len() as f32
        };
        let groups = self.groups()?;
        let context: Vec<bool> = groups.par_iter().map(is_context).collect();
        let is_free = |place: u32, is_context: bool| {
            let own = self.keyframes.binary_search_by_key(&self.anchors.keyframe(place), |keyframe| keyframe.id);
            own.is_ok_and(|k| self.needing.contains(&k) || (self.is_learnable(k) && !is_context))
        };
        let places =
            groups.iter().zip(context).flat_map(|(group, is_context)| group.places.iter().map(move |p| (*p, is_context)));
        let mut fixed: Vec<u32> =
            places.filter(|(place, is_context)| !is_free(*place, *is_context)).map(|(place, _)| place).collect();
        fixed.sort_unstable();
        tracing::debug!(
            learnable = self.learnable.len(),
            near = near.len(),
            fixed = fixed.len(),
            resident = self.cloud.len(),
            "context"
        );
        self.fix(&fixed)
    }

    /// No step moves the Gaussians at these places from now on, and only these.
    pub(super) fn fix(&mut self, places: &[u32]) -> Result<(), MappingError> {
        if !places.is_empty() || self.anchors.fixed().next().is_some() {
            self.cloud.fix(&self.gpu, places)?;
            self.anchors.fix(places);
        }
        Ok(())
    }
}
