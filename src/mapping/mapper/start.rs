//! What a map begins with, before its first keyframe: points, or the map of others.

use glam::Vec3;

use super::{KeyframeId, Mapper, MappingError, initialise_from_points};
use crate::mapping::InitialMap;
use crate::sequence::KnownPoint;
use crate::splat::{Gaussian, GaussianCloud, unit_rotation};

/// Bounds of raw parameters that steps can move again: beyond them, gradients vanish or overflow.
const LOG_SCALES: (f32, f32) = (-16.0, 9.0);
const MOST_RAW_OPACITY: f32 = 9.0;
const MOST_HARMONIC: f32 = 16.0;
/// Gaussians beyond are left out, in the world's unit: none is drawn so far away.
const MOST_COORDINATE: f32 = 1e5;

impl Mapper {
    /// Takes in points of the scene that are known before any keyframe, as many as the limits allow, in the keyframes' world; `anchor` is the first of these.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit or the device fails.
    pub fn add_points(&mut self, known: &[KnownPoint], anchor: KeyframeId) -> Result<(), MappingError> {
        let new = initialise_from_points::gaussians(known, &self.config.points, self.config.sh_degree);
        let room = self.most_gaussians().saturating_sub(self.cloud.len());
        self.begin_with(if new.len() > room { new.thinned(room) } else { new }, anchor)
    }

    /// Takes in a map that is known before any keyframe, in the keyframes' world; `anchor` is the first of these. Its harmonics are those of
    /// this mapper's degree.
    ///
    /// # Errors
    /// [`MappingError`] if a buffer does not fit, a part of the map is frozen and not all of it fits, or the device fails.
    pub fn add_map(&mut self, map: &InitialMap, anchor: KeyframeId) -> Result<(), MappingError> {
        let mut parts = [GaussianCloud::new(self.config.sh_degree), GaussianCloud::new(self.config.sh_degree)];
        for i in 0..map.cloud.len() {
            let part = &mut parts[usize::from(i >= map.frozen)];
            tamed(map.cloud.get(i)).into_iter().for_each(|gaussian| part.push(gaussian));
        }
        self.has_initial_map = true;
        let [frozen, moving] = parts;
        if self.probe(self.cloud.len() + frozen.len() + moving.len()) && !frozen.is_empty() {
            return Err(MappingError::NoRoom { gaussians: frozen.len() + moving.len() });
        }
        self.begin_with(frozen, anchor)?;
        self.cloud.freeze(self.cloud.len());
        self.begin_with(moving, anchor)
    }

    fn begin_with(&mut self, mut new: GaussianCloud, anchor: KeyframeId) -> Result<(), MappingError> {
        if self.probe(self.cloud.len() + new.len()) {
            new = new.thinned(self.cloud.most(&self.gpu) - self.cloud.len());
        }
        let left_out = self.cloud.append(&self.gpu, &new)?;
        self.anchors.append(anchor, new.len() - left_out);
        Ok(())
    }
}

/// The Gaussian within the bounds; none where it has no place.
fn tamed(gaussian: Gaussian) -> Option<Gaussian> {
    let is_finite = gaussian.mean.is_finite()
        && gaussian.log_scale.is_finite()
        && gaussian.rotation.is_finite()
        && gaussian.raw_opacity.is_finite()
        && gaussian.sh.iter().all(|coefficient| coefficient.is_finite());
    (is_finite && gaussian.mean.abs().max_element() <= MOST_COORDINATE).then(|| Gaussian {
        log_scale: gaussian.log_scale.clamp(Vec3::splat(LOG_SCALES.0), Vec3::splat(LOG_SCALES.1)),
        rotation: unit_rotation(gaussian.rotation),
        raw_opacity: gaussian.raw_opacity.clamp(-MOST_RAW_OPACITY, MOST_RAW_OPACITY),
        sh: gaussian.sh.into_iter().map(|c| c.clamp(Vec3::splat(-MOST_HARMONIC), Vec3::splat(MOST_HARMONIC))).collect(),
        ..gaussian
    })
}

#[cfg(test)]
mod tests {
    use glam::Quat;

    use super::*;

    #[test]
    fn what_steps_can_move_stays_and_the_rest_is_bounded_or_left_out() {
        let honest = Gaussian {
            mean: Vec3::new(1.0, -2.0, 3.0),
            log_scale: Vec3::splat(-4.0),
            rotation: Quat::IDENTITY,
            raw_opacity: 2.0,
            sh: vec![Vec3::ONE, Vec3::NEG_ONE],
        };
        assert_eq!(tamed(honest.clone()), Some(honest.clone()));
        let wild = Gaussian {
            log_scale: Vec3::new(1e30, -1e30, 0.0),
            rotation: Quat::from_xyzw(0.0, 0.0, 0.0, 1e-3),
            raw_opacity: 1e9,
            sh: vec![Vec3::splat(-1e20)],
            ..honest.clone()
        };
        let bounded = tamed(wild).unwrap();
        assert_eq!((bounded.log_scale, bounded.rotation), (Vec3::new(LOG_SCALES.1, LOG_SCALES.0, 0.0), Quat::IDENTITY));
        assert_eq!((bounded.raw_opacity, bounded.sh[0]), (MOST_RAW_OPACITY, Vec3::splat(-MOST_HARMONIC)));
        assert_eq!(tamed(Gaussian { mean: Vec3::splat(1e6), ..honest.clone() }), None);
        assert_eq!(tamed(Gaussian { raw_opacity: f32::NAN, ..honest }), None);
    }
}
