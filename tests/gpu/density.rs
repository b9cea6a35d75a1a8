//! Density control on the GPU against its definition: verdicts, histories, and changes of the set of Gaussians.

use std::sync::Arc;

use bytemuck::Zeroable;
use fastrand::Rng;
use keysplat::gpu::{Gpu, GpuBuffer};
use keysplat::optimise::{DensityPasses, GaussianScore, OverScores};
use keysplat::render::layout::{DensitySetup, VERDICT_BITS, VERDICT_REMOVE, VERDICT_SPLIT};
use keysplat::render::{Division, GaussianHistory, GpuCloud, Plan};
use keysplat::splat::{GaussianCloud, ShDegree};
use keysplat::verification::reference::density::{divide, remembered, verdict};

use crate::common::{requirements::adapter, scene};

const COUNT: usize = 3000;

/// Strategies: by several views, by the gradient, none.
const STRATEGIES: [(f32, f32); 3] = [(2.0, f32::MAX), (f32::MAX, 0.4), (f32::MAX, f32::MAX)];

fn setup(cloud: &GpuCloud, (min_age, gradient): (f32, f32)) -> DensitySetup {
    DensitySetup {
        count: cloud.len() as u32,
        capacity: cloud.capacity() as u32,
        round: 6.0,
        min_raw_opacity: -2.5,
        max_log_scale: -1.2,
        min_age,
        min_views: 3.0,
        min_weight: 0.1,
        min_contribution: 1.5,
        faint_raw_opacity: -1.0,
        error_pixels: 3.0,
        pixel_gradient: 0.3,
        split_log_pixels: 2.0,
        gradient,
        split_or_clone_log_pixels: 2.5,
        pad: 0,
    }
}

/// A map with scores and histories of all kinds.
struct Scene {
    gpu: Arc<Gpu>,
    host: GaussianCloud,
    cloud: GpuCloud,
    scores: Vec<GaussianScore>,
    on_gpu: GpuBuffer,
    histories: Vec<GaussianHistory>,
}

fn made_up() -> Option<Scene> {
    let gpu = adapter()?;
    let mut rng = Rng::with_seed(31);
    let host = scene(&mut rng, COUNT, ShDegree::ALL[1]);
    let mut cloud = GpuCloud::new(&gpu, host.sh_degree, COUNT).unwrap();
    assert_eq!(cloud.append(&gpu, &host).unwrap(), 0);
    let mut share = |most: f32| most * rng.f32();
    let score = |views: f32, share: &mut dyn FnMut(f32) -> f32| GaussianScore {
        error_pixels: share(8.0) * views,
        weighted_error_pixels: share(3.0) * views,
        weight_sum: share(6.0) * views,
        weight_max: share(0.5),
        gradient: share(0.8) * views,
        absolute_gradient: share(0.9) * views,
        views,
        metres_per_pixel: 0.001 + share(0.02),
    };
    let scores: Vec<GaussianScore> =
        (0..COUNT).map(|i| if i % 5 == 0 { GaussianScore::default() } else { score((i % 4) as f32 + 1.0, &mut share) }).collect();
    let history = |i: usize| GaussianHistory {
        views: (i % 6) as f32,
        best_weight: share(0.4),
        contribution: share(4.0),
        came: (i % 7) as f32,
    };
    let histories: Vec<GaussianHistory> = (0..COUNT).map(history).collect();
    cloud.histories().write(&gpu, 0, &histories);
    let on_gpu = GpuBuffer::storage(&gpu, "scores", cloud.capacity() as u64 * 32).unwrap();
    let seen: Vec<[f32; 4]> =
        scores.iter().map(|s| [s.error_pixels, s.weighted_error_pixels, s.weight_sum, s.weight_max]).collect();
    let by_view: Vec<[f32; 4]> = scores.iter().map(|s| [s.gradient, s.absolute_gradient, s.views, s.metres_per_pixel]).collect();
    on_gpu.write(&gpu, 0, &seen);
    on_gpu.write(&gpu, cloud.capacity(), &by_view);
    Some(Scene { gpu, host, cloud, scores, on_gpu, histories })
}

impl Scene {
    fn verdicts(&self, passes: &mut DensityPasses, setup: &DensitySetup) -> Vec<u32> {
        passes.prepare(&self.gpu, setup).unwrap();
        let verdicts = passes.verdicts(&self.gpu, &self.cloud);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        verdicts.encode(&mut encoder.begin_compute_pass(&Default::default()), &self.on_gpu);
        self.gpu.read(Some(encoder), &[verdicts.part()]).unwrap().part(0)
    }
}

#[test]
fn verdicts_are_those_of_their_definition() {
    let Some(scene) = made_up() else { return };
    let mut passes = DensityPasses::new(&scene.gpu).unwrap();
    for strategy in STRATEGIES {
        let setup = setup(&scene.cloud, strategy);
        let found = scene.verdicts(&mut passes, &setup);
        let expected = (0..COUNT).map(|i| verdict(&setup, &scene.host.get(i), &scene.scores[i], &scene.histories[i]));
        let mut kinds = std::collections::BTreeMap::<u32, usize>::new();
        for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
            *kinds.entry(expected & VERDICT_BITS).or_default() += 1;
            assert_eq!(found & VERDICT_BITS, expected & VERDICT_BITS, "{i}: {:?}", scene.scores[i]);
            let score = |word: u32| f32::from_bits(word & !VERDICT_BITS);
            assert!((score(*found) - score(expected)).abs() <= 1e-5 * score(expected), "{i}");
        }
        let least = if strategy == STRATEGIES[2] { 4 } else { 5 };
        assert!(kinds.len() >= least && kinds.values().all(|&count| count > 10), "{strategy:?}: {kinds:?}");
    }
}

#[test]
fn what_is_not_finite_goes_whatever_the_strategy() {
    let Some(scene) = made_up() else { return };
    let mut passes = DensityPasses::new(&scene.gpu).unwrap();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let places = |plane: usize| (0..3).flat_map(move |lane| bad.map(|value| (plane, lane, value)));
    for (i, (plane, lane, value)) in (0..3).flat_map(places).enumerate() {
        let place = plane * scene.cloud.capacity() + 7 * i;
        let mut vector: [f32; 4] = scene.cloud.averages().read(&scene.gpu, place, 1).unwrap()[0];
        vector[lane] = value;
        scene.cloud.averages().write(&scene.gpu, place, &[vector]);
    }
    for strategy in STRATEGIES {
        let found = scene.verdicts(&mut passes, &setup(&scene.cloud, strategy));
        assert!((0..27).all(|i| found[7 * i] & VERDICT_SPLIT == 0 && found[7 * i] & VERDICT_REMOVE != 0), "{strategy:?}");
    }
}

#[test]
fn histories_remember_the_best_of_all_views() {
    let Some(scene) = made_up() else { return };
    let mut passes = DensityPasses::new(&scene.gpu).unwrap();
    passes.prepare(&scene.gpu, &setup(&scene.cloud, STRATEGIES[2])).unwrap();
    passes.remember(&scene.gpu, &scene.cloud, &scene.on_gpu);
    let found: Vec<GaussianHistory> = scene.cloud.histories().read(&scene.gpu, 0, COUNT).unwrap();
    for ((found, history), score) in found.iter().zip(&scene.histories).zip(&scene.scores) {
        let expected = remembered(history, score);
        assert!((found.contribution - expected.contribution).abs() <= 1e-6 * expected.contribution);
        assert_eq!((found.views, found.best_weight, found.came), (expected.views, expected.best_weight, expected.came));
    }
}

/// Removals and divisions, within the map's space and beyond it: everything of a Gaussian follows it.
#[test]
fn a_plan_keeps_order_and_children_are_those_of_their_definition() {
    for growing in [false, true] {
        let Some(Scene { gpu, host, mut cloud, histories, .. }) = made_up() else { return };
        let moments: Vec<[f32; 4]> = (0..cloud.planes() * cloud.capacity()).map(|i| [i as f32; 4]).collect();
        cloud.moments_1().write(&gpu, 0, &moments);
        (0..4).for_each(|_| cloud.begin_round());
        let capacity = cloud.capacity();
        let (every, divided_every) = if growing { (3, 3) } else { (2, 10) };
        let removed: Vec<u32> = (0..COUNT as u32).filter(|i| i % every == 1).collect();
        let division = |i: u32| if i.is_multiple_of(4) { Division::Split } else { Division::Clone };
        let divided: Vec<(u32, Division)> = (1..COUNT as u32).step_by(divided_every).map(|i| (i, division(i))).collect();
        let plan = Plan { removed: removed.clone(), divided: divided.clone() };
        cloud.apply(&gpu, &plan).unwrap();
        assert_eq!(cloud.len(), plan.len_after(COUNT));
        let found = cloud.download(&gpu).unwrap();
        let kept: Vec<usize> = (0..COUNT).filter(|i| removed.binary_search(&(*i as u32)).is_err()).collect();
        for (place, i) in kept.iter().enumerate() {
            assert_eq!(found.get(place), host.get(*i));
        }
        let children = divided.iter().flat_map(|(parent, division)| divide(&host.get(*parent as usize), *division));
        for (place, expected) in (kept.len()..).zip(children) {
            let child = found.get(place);
            assert!((child.mean - expected.mean).length() < 1e-5, "{child:?} {expected:?}");
            assert!((child.log_scale - expected.log_scale).length() < 1e-5 && child.sh == expected.sh);
            assert!((child.raw_opacity - expected.raw_opacity).abs() < 1e-4 && child.rotation == expected.rotation);
        }
        let sources: Vec<usize> =
            kept.iter().copied().chain(divided.iter().flat_map(|(parent, _)| [*parent as usize; 2])).collect();
        let of_plane: Vec<[f32; 4]> = cloud.moments_1().read(&gpu, 2 * cloud.capacity(), cloud.len()).unwrap();
        assert!(of_plane.iter().zip(&sources).all(|(moment, source)| *moment == [(2 * capacity + source) as f32; 4]));
        let remembered: Vec<GaussianHistory> = cloud.histories().read(&gpu, 0, cloud.len()).unwrap();
        let child = GaussianHistory { came: 4.0, ..GaussianHistory::zeroed() };
        let of = |place: usize| if place < kept.len() { histories[sources[place]] } else { child };
        assert!((0..cloud.len()).all(|place| remembered[place] == of(place)));
        // And those that are appended later come without either.
        cloud.append(&gpu, &host).unwrap();
        let place = cloud.len() - COUNT;
        assert_eq!(cloud.histories().read::<GaussianHistory>(&gpu, place, 1).unwrap(), [child]);
        assert_eq!(cloud.moments_1().read::<[f32; 4]>(&gpu, place, 1).unwrap(), [[0.0; 4]]);
        assert_eq!(cloud.download(&gpu).unwrap().get(place + 5), host.get(5));
    }
}
