//! Holding the map within bounds on a recording of any length: how many Gaussians there may be, which go when others need their place, and
//! which keyframes' images leave the GPU.

use serde::{Deserialize, Serialize};

use super::keyframe::MappedKeyframe;
use crate::render::{GaussianHistory, GpuCloud};
use crate::splat::ShDegree;

/// Bytes that the rasterizer's scratch, the scores and the verdicts take for each Gaussian.
pub(super) const SCRATCH_BYTES_EACH: u64 = 128;
/// Bytes for each in the list of changes, while the map changes: at most all of them go.
pub(super) const LIST_BYTES_EACH: u64 = 4;
/// A part in so many of the bound on memory is kept for buffers that views outgrow.
const MARGIN_DIVISOR: u64 = 32;
/// Share of the memory that keyframes' images may take.
const IMAGES_SHARE: f64 = 0.4;
/// At least this many Gaussians are always allowed: less is no map.
const LEAST_GAUSSIANS: usize = 1000;
const LEAST_KEYFRAMES: usize = 8;
/// New Gaussians of one keyframe may take at most this share of all places.
const INSERTED_SHARE: f64 = 0.5;

/// Resource limits of the mapper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsConfig {
    /// Most Gaussians at any time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<usize>,
    /// Most bytes of GPU memory, as well as it can be foreseen.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gpu_bytes: Option<u64>,
    /// Keyframes whose images stay on the GPU; a step uploads any other.
    pub max_gpu_images: usize,
    /// Most bytes of host memory for these others; the rest is in a temporary file.
    pub max_host_bytes: u64,
}

impl Default for LimitsConfig {
    fn default() -> Self {
        Self { max_gaussians: None, max_gpu_bytes: None, max_gpu_images: 400, max_host_bytes: 3 << 30 }
    }
}

impl LimitsConfig {
    /// Whether the number of Gaussians is limited at all.
    pub(super) fn limits_gaussians(&self) -> bool {
        self.max_gaussians.is_some() || self.max_gpu_bytes.is_some()
    }

    /// The most Gaussians on the GPU by their number in the whole map, when `away` are elsewhere.
    pub(super) fn gaussians(&self, away: usize) -> usize {
        self.max_gaussians.map_or(usize::MAX, |most| most.saturating_sub(away).max(LEAST_GAUSSIANS))
    }

    /// The most by memory, of `bytes_each` in the map, when buffers that don't depend on their number take `other_bytes`.
    pub(super) fn gaussians_on_gpu(&self, bytes_each: u64, other_bytes: u64) -> usize {
        let each = bytes_each + SCRATCH_BYTES_EACH + LIST_BYTES_EACH;
        let most = |limit: u64| ((limit - limit / MARGIN_DIVISOR).saturating_sub(other_bytes) / each) as usize;
        self.max_gpu_bytes.map_or(usize::MAX, most).max(LEAST_GAUSSIANS)
    }

    /// The most Gaussians of a finished map that may be on the adapter to be rendered, when it has `gpu_bytes` in use: half of what is left is for what
    /// the views need.
    pub fn most_rendered(&self, gpu_bytes: u64, sh_degree: ShDegree) -> usize {
        let each = GpuCloud::bytes_for_each(sh_degree) + SCRATCH_BYTES_EACH;
        let most = |limit: u64| (limit.saturating_sub(gpu_bytes) / 2 / each) as usize;
        self.max_gpu_bytes.map_or(usize::MAX, most).max(LEAST_GAUSSIANS)
    }

    /// Bytes of `bytes` in use that don't depend on the number of Gaussians, when the map has `map_bytes` and the last step had room for `stepped` of them.
    pub(super) fn other_bytes(bytes: u64, map_bytes: u64, stepped: usize) -> u64 {
        bytes.saturating_sub(map_bytes + stepped as u64 * SCRATCH_BYTES_EACH)
    }

    /// The most images of `image_bytes` each on the GPU.
    pub(super) fn gpu_images(&self, image_bytes: u64) -> usize {
        let by_memory =
            self.max_gpu_bytes.map_or(usize::MAX, |limit| (IMAGES_SHARE * limit as f64) as usize / image_bytes.max(1) as usize);
        self.max_gpu_images.min(by_memory).max(LEAST_KEYFRAMES)
    }

    /// Checks every value.
    ///
    /// # Errors
    /// A description of the first invalid value.
    pub fn validate(&self) -> Result<(), String> {
        if self.max_gaussians.is_some_and(|n| n < LEAST_GAUSSIANS) {
            return Err(format!("max_gaussians must be at least {LEAST_GAUSSIANS}"));
        }
        if self.max_gpu_images < LEAST_KEYFRAMES {
            return Err(format!("max_gpu_images must be at least {LEAST_KEYFRAMES}"));
        }
        Ok(())
    }
}

/// How many of `inserted` new Gaussians may come into a map of at most `most` Gaussians.
pub(super) fn insertions_allowed(inserted: usize, most: usize) -> usize {
    inserted.min((INSERTED_SHARE * most as f64) as usize)
}

/// The same before the first step, when nothing is scored: with as many of the `others` that came before gone, the `most` that stay are an even sample of all.
pub(super) fn sampled(inserted: usize, others: usize, most: usize) -> usize {
    let all = inserted + others;
    if all <= most { inserted } else { (inserted as u128 * most as u128).div_ceil(all as u128) as usize }
}

/// The `excess` Gaussians to remove: the least useful, the older first among equals. Those that no view has scored yet, and that came after
/// `scored_round`, go last. Ascending.
pub(super) fn least_contributions(histories: &[GaussianHistory], excess: usize, scored_round: f32) -> Vec<u32> {
    let contribution = |i: &u32| {
        let history = &histories[*i as usize];
        if history.views == 0.0 && history.came > scored_round { f32::INFINITY } else { history.contribution }
    };
    let mut ranked: Vec<u32> = (0..histories.len() as u32).collect();
    if excess < ranked.len() {
        ranked.select_nth_unstable_by(excess, |a, b| contribution(a).total_cmp(&contribution(b)).then(a.cmp(b)));
        ranked.truncate(excess);
    }
    ranked.sort_unstable();
    ranked
}

/// The keyframe whose image leaves the GPU first: of those that have one there and are not among the `recent` newest, the one between the two
/// nearest neighbours in time. The first stays, it holds the world.
pub(super) fn least_needed_keyframe(keyframes: &[MappedKeyframe], recent: usize) -> Option<usize> {
    let with_image: Vec<usize> = (0..keyframes.len().saturating_sub(recent)).filter(|&k| keyframes[k].is_resident()).collect();
    // Radians and metres weigh alike: at a metre's distance they move the image alike.
    let apart = |a: usize, b: usize| {
        let b_from_a = keyframes[b].camera.camera_from_world * keyframes[a].camera.camera_from_world.inverse();
        b_from_a.translation.vector.norm() + b_from_a.rotation.angle()
    };
    let detour = |w: &[usize]| apart(w[0], w[1]) + apart(w[1], w[2]);
    with_image.windows(3).min_by(|a, b| detour(a).total_cmp(&detour(b))).map(|w| w[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_useful_go_first() {
        let histories = [0.3, 0.0, 2.0, 0.0, 0.1].map(|contribution| GaussianHistory {
            contribution,
            came: 3.0,
            ..GaussianHistory::default()
        });
        assert_eq!(least_contributions(&histories, 1, 3.0), [1]);
        assert_eq!(least_contributions(&histories, 3, 3.0), [1, 3, 4]);
        assert!(least_contributions(&histories, 0, 3.0).is_empty());
        assert_eq!(least_contributions(&histories, 9, 3.0), [0, 1, 2, 3, 4]);
        // Those that came later and were not scored go last.
        let mut some_scored = histories;
        [0, 2, 4].into_iter().for_each(|i| some_scored[i].views = 1.0);
        assert_eq!(least_contributions(&some_scored, 2, 2.0), [0, 4]);
    }

    #[test]
    fn places_go_to_all_insertions_alike() {
        assert_eq!(sampled(300, 700, 1000), 300);
        assert_eq!(sampled(300, 900, 600), 150);
        let mut kept = vec![1000];
        for k in 1..20 {
            let new = sampled(1000, 1000 * k, 2000);
            let old: usize = kept.iter().sum();
            let share = (2000 - new).min(old) as f64 / old as f64;
            kept.iter_mut().for_each(|count| *count = (*count as f64 * share).round() as usize);
            kept.push(new);
        }
        assert!(kept.iter().all(|count| (95..=105).contains(count)), "{kept:?}");
    }

    #[test]
    fn memory_is_shared_by_images_and_gaussians() {
        let limits = LimitsConfig { max_gpu_bytes: Some(100_000_000), ..LimitsConfig::default() };
        assert_eq!(limits.gpu_images(1_000_000), 40);
        let most = limits.gaussians_on_gpu(672, 40_000_000);
        assert!((70_000..71_000).contains(&most), "{most}");
        let bounded = LimitsConfig { max_gaussians: Some(5000), ..limits };
        assert_eq!([0, 1000, 6000].map(|away| bounded.gaussians(away)), [5000, 4000, LEAST_GAUSSIANS]);
        assert!(LimitsConfig { max_gaussians: Some(5), ..LimitsConfig::default() }.validate().is_err());
    }
}
