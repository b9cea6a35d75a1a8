//! What cameras see of a region.

use glam::Vec3;
use rayon::prelude::*;

use super::{Coverage, Place, Region};
use crate::splat::{GaussianCloud, ViewCamera};

/// A camera sees a region that fills at least this share of its image.
const LEAST_SEEN: f32 = 0.02;
/// A Gaussian beyond the halo belongs to the context if it gives so much of a block's light.
const LEAST_SHARE: f32 = 0.01;

/// What a camera that sees a region has in its image.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionView {
    /// Blocks, row-major, that show the region or its halo more than what lies beyond.
    pub valid: Vec<bool>,
    /// Gaussians beyond the halo in and around these blocks, in any order and more than once.
    pub context: Vec<u32>,
}

impl RegionView {
    /// What a camera has of a region, when each Gaussian has this place; `None` if it does not see the region.
    pub fn of(coverage: &Coverage, places: &[Place]) -> Option<Self> {
        let (mut near, mut beyond) = (vec![0.0f32; coverage.blocks()], vec![0.0f32; coverage.blocks()]);
        let mut core = 0.0;
        for (block, gaussian, share) in &coverage.shares {
            let place = places[*gaussian as usize];
            let of_block = if place == Place::Beyond { &mut beyond } else { &mut near };
            of_block[*block as usize] += share;
            core += if place == Place::Core { *share } else { 0.0 };
        }
        if core < least_seen(coverage) {
            return None;
        }
        let valid: Vec<bool> = near.iter().zip(&beyond).map(|(near, beyond)| near >= beyond).collect();
        let around = coverage.widened(&valid);
        let is_context = |(block, gaussian, share): &&(u32, u32, f32)| {
            around[*block as usize] && *share >= LEAST_SHARE && places[*gaussian as usize] == Place::Beyond
        };
        let context = coverage.shares.iter().filter(is_context).map(|(_, gaussian, _)| *gaussian).collect();
        Some(Self { valid, context })
    }
}

fn least_seen(coverage: &Coverage) -> f32 {
    LEAST_SEEN * coverage.blocks() as f32
}

/// The number of cameras that see each region. Regions do not overlap.
pub fn cameras_that_see(cloud: &GaussianCloud, regions: &[Region], cameras: &[ViewCamera]) -> Vec<usize> {
    let region_of = |mean: &Vec3| regions.iter().position(|region| region.place(*mean) == Place::Core);
    let owners: Vec<Option<usize>> = cloud.means.par_iter().map(region_of).collect();
    let seen_by = |camera: &ViewCamera| {
        let coverage = Coverage::of(cloud, camera);
        let mut shares = vec![0.0f32; regions.len()];
        for (_, gaussian, share) in &coverage.shares {
            owners[*gaussian as usize].into_iter().for_each(|region| shares[region] += share);
        }
        shares.into_iter().map(|share| usize::from(share >= least_seen(&coverage))).collect::<Vec<usize>>()
    };
    let sum = |a: Vec<usize>, b: Vec<usize>| a.into_iter().zip(b).map(|(a, b)| a + b).collect();
    cameras.par_iter().map(seen_by).reduce(|| vec![0; regions.len()], sum)
}

#[cfg(test)]
mod tests {
    use glam::Quat;

    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::splat::{Gaussian, ShDegree};

    /// A wall of Gaussians at a depth of two metres, from -2 to 2 metres.
    fn wall() -> GaussianCloud {
        let mut cloud = GaussianCloud::new(ShDegree::new(0).unwrap());
        for (row, column) in (0..20).flat_map(|row| (0..40).map(move |column| (row, column))) {
            let mean = Vec3::new(column as f32 * 0.1 - 1.95, row as f32 * 0.1 - 0.95, 2.0);
            let log_scale = Vec3::splat(0.06f32.ln());
            cloud.push(Gaussian { mean, log_scale, rotation: Quat::IDENTITY, raw_opacity: 4.0, sh: vec![Vec3::ONE] });
        }
        cloud
    }

    fn camera(x: f64) -> ViewCamera {
        let pinhole = Pinhole { fx: 64.0, fy: 64.0, cx: 31.5, cy: 23.5, width: 64, height: 48 };
        ViewCamera { pinhole, camera_from_world: Se3::translation(-x, 0.0, 0.0) }
    }

    fn region(low: f32, high: f32) -> Region {
        Region { low: [low, -5.0, 0.0], high: [high, 5.0, 5.0], halo: 0.25 }
    }

    #[test]
    fn pixels_belong_to_the_region_and_its_halo_and_the_context_lies_beside_them() {
        let cloud = wall();
        let region = region(0.0, 2.0);
        let places: Vec<Place> = cloud.means.iter().map(|mean| region.place(*mean)).collect();
        let seen = RegionView::of(&Coverage::of(&cloud, &camera(0.0)), &places).unwrap();
        // The border lies in the middle of the image, and the halo is one block wide.
        for (block, valid) in seen.valid.iter().enumerate() {
            assert_eq!(*valid, block % 8 >= 3, "{block}");
        }
        let context: Vec<f32> = seen.context.iter().map(|gaussian| cloud.means[*gaussian as usize].x).collect();
        assert!(!context.is_empty() && context.iter().all(|x| (-0.9..-0.25).contains(x)), "{context:?}");
        assert_eq!(RegionView::of(&Coverage::of(&cloud, &camera(-1.5)), &places), None);
    }

    #[test]
    fn cameras_are_counted_for_each_region() {
        let regions = [region(-2.0, 0.0), region(0.0, 2.0), region(50.0, 60.0)];
        let cameras = [camera(-1.2), camera(0.0), camera(1.2), camera(1.5)];
        assert_eq!(cameras_that_see(&wall(), &regions, &cameras), [2, 3, 0]);
    }
}
