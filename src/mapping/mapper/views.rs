//! What steps learn from while a part of the map is away. A view leaves out the pixels in which something is seen that is away. Gaussians of which the
//! views say too little are rendered, and stay as they are: steps from others would spoil what their own views taught.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;

use super::Mapper;
use super::paging::Group;
use crate::mapping::MappingError;
use crate::mapping::chunks::{Hidden, OrientedBox, Outlook};

/// Share of an image that steps learn from at least.
const LEAST_SEEN: f32 = 0.5;
/// Share of the pixels in which the keyframes near by see a Gaussian that steps learn from, at least, where the Gaussian is to be moved. Few near views
/// have more of them than many distant ones.
const LEAST_LEARNABLE: f32 = 0.75;
/// Keyframes near by that are looked at, so that the work for a keyframe does not grow with the map; image-only ones between them come on top.
const NEAR: usize = 256;

/// A keyframe near by.
struct View<'a> {
    outlook: Outlook<'a>,
    is_learnable: bool,
    /// Where it sees something that is away, if anywhere; unknown where steps do not learn from it.
    hidden: Option<Hidden>,
}

impl View<'_> {
    /// Whether steps learn from all pixels in which the view sees the box.
    fn shows(&self, bounds: &OrientedBox) -> bool {
        self.is_learnable && self.hidden.as_ref().is_none_or(|hidden| !self.outlook.is_hidden(bounds, hidden))
    }
}

/// Share of the pixels in which views show a box that steps learn from; all where none shows it.
fn learnt_share<'a>(views: impl Iterator<Item = &'a View<'a>>, bounds: &OrientedBox) -> f32 {
    let (mut seen, mut learnt) = (0.0, 0.0);
    for view in views {
        let pixels = view.outlook.pixel_density(bounds);
        seen += pixels;
        learnt += if pixels > 0.0 && view.shows(bounds) { pixels } else { 0.0 };
    }
    if seen > 0.0 { learnt / seen } else { 1.0 }
}

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

    /// Fixes the Gaussians on the GPU that steps would spoil. Free are those of which most of what the keyframes near by see can be learnt, and those of
    /// the window's keyframes that show them whole.
    pub(super) fn fix_context(&mut self) -> Result<(), MappingError> {
        if self.chunks.are_here() {
            return self.fix(&[]);
        }
        self.find_learnable();
        let near = self.keyframes_near(self.needing[0]);
        let near: BTreeSet<usize> = near.iter().chain(&self.learnable).copied().collect();
        let views: BTreeMap<usize, View<'_>> = near.par_iter().map(|k| (*k, self.view(*k))).collect();
        let groups = self.groups()?;
        let fixed_of = |group: &Group| {
            let is_context = learnt_share(views.values(), &group.bounds) < LEAST_LEARNABLE;
            let is_free = |place: &u32| {
                let own = self.keyframes.binary_search_by_key(&self.anchors.keyframe(*place), |keyframe| keyframe.id);
                !is_context
                    || own.is_ok_and(|k| self.needing.contains(&k) && views.get(&k).is_some_and(|view| view.shows(&group.bounds)))
            };
            group.places.iter().copied().filter(|place| !is_free(place)).collect::<Vec<u32>>()
        };
        let mut fixed: Vec<u32> = groups.par_iter().flat_map_iter(fixed_of).collect();
        fixed.sort_unstable();
        let (learnable, resident) = (self.learnable.len(), self.cloud.len());
        tracing::debug!(learnable, near = near.len(), fixed = fixed.len(), resident, "context");
        self.fix(&fixed)
    }

    /// What steps can learn from a keyframe.
    fn view(&self, k: usize) -> View<'_> {
        let outlook = self.keyframes[k].outlook();
        let is_learnable = self.is_learnable(k);
        let hidden = if is_learnable { self.chunks.hidden_from(&outlook) } else { None };
        View { outlook, is_learnable, hidden }
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

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use image::RgbImage;

    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::mapping::chunks::Sight;
    use crate::sequence::RectifiedImage;
    use crate::splat::ViewCamera;

    fn cube(x: f32, z: f32, half: f32) -> OrientedBox {
        OrientedBox::cube(Vec3::new(x, 0.0, z), half)
    }

    #[test]
    fn the_nearest_views_decide_and_only_where_they_are_whole() {
        let pinhole = Pinhole { fx: 64.0, fy: 64.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
        let sight = Sight::of(&RectifiedImage { pinhole, color: RgbImage::new(64, 48), depth: None, valid: None });
        let outlook = |z: f64| sight.from(&ViewCamera { pinhole, camera_from_world: Se3::translation(0.0, 0.0, -z) });
        let beside = |z: f64, x: f32| {
            let mut hidden = outlook(z).nothing_hidden();
            outlook(z).hide(&cube(x, 19.0, 0.2), &mut hidden);
            View { outlook: outlook(z), is_learnable: true, hidden: Some(hidden) }
        };
        let view = |z: f64, is_learnable: bool| View { outlook: outlook(z), is_learnable, hidden: None };
        let (far, near) = (|| view(0.0, false), || view(18.0, true));
        let share = |views: &[View<'_>]| learnt_share(views.iter(), &cube(0.0, 20.0, 0.1));
        assert!(share(&[far(), far(), far(), near()]) > LEAST_LEARNABLE);
        assert!(share(&[far(), view(2.0, true)]) < LEAST_LEARNABLE);
        assert_eq!((share(&[far()]), share(&[])), (0.0, 1.0));
        // What is away stands in the way of one of two, and beside the other.
        assert!((share(&[beside(18.0, 0.0), beside(18.0, 0.6)]) - 0.5).abs() < 1e-3);
    }
}
