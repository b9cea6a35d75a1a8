//! Merging keeps mass and moments, and files hold what they name.

use glam::{Quat, Vec3};
use proptest::prelude::*;

use super::cells::{Tree, divide};
use super::merge::{Blob, gaussian, merged};
use super::*;
use crate::export::tests::cloud;
use crate::splat::{Gaussian, ShDegree, opacity_from_raw};

fn pair(gaussians: [Gaussian; 2]) -> [Blob; 2] {
    let mut cloud = GaussianCloud::new(ShDegree::default());
    gaussians.into_iter().for_each(|gaussian| cloud.push(gaussian));
    [Blob::new(&cloud, 0), Blob::new(&cloud, 1)]
}

fn disc(x: f32, raw_opacity: f32) -> Gaussian {
    let log_scale = Vec3::new(0.1f32.ln(), 0.1f32.ln(), 0.001f32.ln());
    Gaussian { mean: Vec3::new(x, 0.0, 2.0), log_scale, rotation: Quat::IDENTITY, raw_opacity, sh: vec![Vec3::ONE] }
}

#[test]
fn two_equal_gaussians_side_by_side_keep_mass_and_moments() {
    let [a, b] = pair([disc(-0.3, -2.0), disc(0.3, -2.0)]);
    let both = merged(&a, &b);
    assert!(both.mean.xy().norm() < 1e-9 && (both.mean.z - 2.0).abs() < 1e-9);
    // Variance of two points at ±0.3, and that of each.
    let expected = [0.09 + 0.01, 0.01, 1e-6];
    (0..3).for_each(|k| assert!((both.covariance[(k, k)] / expected[k] - 1.0).abs() < 1e-5, "{k}"));
    // At a distance of six extents they hide next to nothing of each other.
    assert!((both.mass() / (2.0 * a.mass()) - 1.0).abs() < 1e-3, "{} of {}", both.mass(), 2.0 * a.mass());
}

#[test]
fn what_is_covered_twice_counts_once_and_opaque_ones_grow() {
    let [a, b] = pair([disc(0.0, 0.0), disc(0.0, 0.0)]);
    // 1 - (1 - g/2)² integrates to 2·½ - ½·¼ of a Gaussian's area.
    assert!((merged(&a, &b).opacity - 0.875).abs() < 1e-6);
    let [a, b] = pair([disc(-0.1, 8.0), disc(0.1, 8.0)]);
    let both = merged(&a, &b);
    assert!(both.opacity <= 0.999 && both.covariance[(1, 1)] > 1.05 * a.covariance[(1, 1)]);
}

fn any_gaussian() -> impl Strategy<Value = Gaussian> {
    let extreme = prop_oneof![-6f32..1.0, Just(-1e30f32), Just(1e30f32), Just(-200f32)];
    let vector = |value: std::ops::Range<f32>| prop::array::uniform3(value).prop_map(Vec3::from);
    let rotation = prop::array::uniform4(-1f32..1.0).prop_map(Quat::from_array);
    let opacity = prop_oneof![-6f32..6.0, Just(-1e30f32), Just(1e30f32)];
    (vector(-5.0..5.0), prop::array::uniform3(extreme), rotation, opacity, vector(-3.0..3.0)).prop_map(
        |(mean, scale, rotation, raw_opacity, color)| Gaussian {
            mean,
            log_scale: Vec3::from(scale),
            rotation,
            raw_opacity,
            sh: vec![color],
        },
    )
}

proptest! {
    #[test]
    fn a_merged_gaussian_is_one(a in any_gaussian(), b in any_gaussian()) {
        let [a, b] = pair([a, b]);
        let both = merged(&a, &b);
        prop_assert!(both.opacity > 0.0 && both.opacity < 1.0);
        let one = gaussian(&both, vec![Vec3::ZERO]);
        let mut cloud = GaussianCloud::new(ShDegree::default());
        cloud.push(one);
        prop_assert_eq!(cloud.first_non_finite(), None);
        prop_assert!((cloud.rotations[0].length() - 1.0).abs() < 1e-4);
        // Written as extents and a rotation, it has the same covariance, below the bound of extents.
        let again = Blob::new(&cloud, 0);
        let is_bounded = both.covariance.norm() > 1e25;
        prop_assert!(is_bounded || (again.covariance - both.covariance).norm() <= 1e-4 * both.covariance.norm());
        prop_assert!(cloud.log_scales[0].min_element() > -30.1, "no axis is lost");
    }
}

/// A surface of discs whose colour changes slowly.
fn carpet(count: usize) -> GaussianCloud {
    let mut rng = fastrand::Rng::with_seed(5);
    let mut cloud = GaussianCloud::new(ShDegree::ALL[1]);
    for _ in 0..count {
        let (x, y) = (rng.f32() * 4.0, rng.f32() * 4.0);
        let shade = Vec3::new(x.sin(), y.cos(), 0.2);
        cloud.push(Gaussian {
            mean: Vec3::new(x, y, 2.0),
            log_scale: Vec3::new(-3.5, -3.5, -7.0),
            rotation: Quat::IDENTITY,
            raw_opacity: rng.f32() * 4.0 - 2.0,
            sh: vec![shade, shade * 0.1, Vec3::ZERO, Vec3::ZERO],
        });
    }
    cloud
}

#[test]
fn levels_are_quarters_that_keep_the_mass() {
    let map = carpet(20_000);
    let levels = Levels::new(&map);
    assert_eq!(levels.counts(), [20_000, 5_000, 1_250]);
    let mass = |cloud: &GaussianCloud| (0..cloud.len()).map(|i| Blob::new(cloud, i).mass()).sum::<f64>();
    let center = |cloud: &GaussianCloud| {
        let sum =
            (0..cloud.len()).map(|i| Blob::new(cloud, i)).map(|blob| blob.mean * blob.mass()).sum::<nalgebra::Vector3<f64>>();
        sum / mass(cloud)
    };
    for level in 0..3 {
        let merged = levels.level(level);
        let share = mass(&merged) / mass(&map);
        // What neighbours cover twice is lost.
        assert!((0.65..1.001).contains(&share), "level {level}: {share}");
        assert!((center(&merged) - center(&map)).norm() < 0.05);
        assert!(merged.raw_opacities.iter().all(|raw| opacity_from_raw(*raw) < 1.0));
        // The surface stays as thin as it was.
        assert!((0..merged.len()).all(|i| Blob::new(&merged, i).covariance[(2, 2)].sqrt() < 0.002));
    }
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one_thread.install(|| Levels::new(&map)).level(2), levels.level(2), "on any number of threads");
    let metres = levels.base_distance().unwrap();
    assert!((20.0..200.0).contains(&metres), "{metres}");
}

#[test]
fn few_gaussians_and_equal_ones_have_levels_too() {
    assert_eq!(Levels::new(&GaussianCloud::default()).counts(), [0]);
    assert_eq!(Levels::new(&cloud(ShDegree::default(), 1)).counts(), [1]);
    assert_eq!(Levels::new(&cloud(ShDegree::default(), 1)).base_distance(), None);
    let mut equal = GaussianCloud::new(ShDegree::default());
    (0..5000).for_each(|_| equal.push(disc(0.0, 1.0)));
    let levels = Levels::new(&equal);
    assert_eq!(levels.counts(), [5000, 1250]);
    assert_eq!(levels.level(1).first_non_finite(), None);
}

#[test]
fn cells_are_bounded_and_hold_each_point_once() {
    let map = cloud(ShDegree::default(), 1000);
    let (tree, leaves) = divide(&map.means, 60);
    let mut all: Vec<usize> = leaves.concat();
    all.sort_unstable();
    assert_eq!(all, (0..1000).collect::<Vec<_>>());
    assert!(leaves.iter().all(|leaf| (30..=60).contains(&leaf.len())));
    fn numbers(tree: &Tree) -> Vec<usize> {
        match tree {
            Tree::Leaf(number) => vec![*number],
            Tree::Branch(parts) => parts.iter().flat_map(numbers).collect(),
        }
    }
    assert_eq!(numbers(&tree), (0..leaves.len()).collect::<Vec<_>>());
}

#[test]
fn pieces_hold_whole_cells_of_one_level() {
    let cell = |len: usize| {
        let mut cell = GaussianCloud::new(ShDegree::default());
        (0..len).for_each(|_| cell.push(disc(0.0, 1.0)));
        cell
    };
    let levels = Levels { tree: Tree::Leaf(0), levels: vec![vec![cell(4096); 40], vec![cell(1024); 40]] };
    let pieces = levels.pieces();
    let found: Vec<_> = pieces.iter().map(|piece| (piece.level, piece.number, piece.cells.len())).collect();
    assert_eq!(found, [(0, 0, 16), (0, 1, 16), (0, 2, 8), (1, 0, 40)]);
    assert_eq!(pieces.iter().take(3).flat_map(|piece| piece.cells.clone()).collect::<Vec<_>>(), (0..40).collect::<Vec<_>>());
}

#[test]
fn a_write_that_fails_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = cloud(ShDegree::default(), 10);
    map.raw_opacities[3] = f32::NAN;
    let out = folder.path().join("new");
    assert!(Levels::new(&map).write(&[], &out).is_err());
    assert!(!out.exists());
    let map = cloud(ShDegree::default(), 10);
    Levels::new(&map).write(&[], &out).unwrap();
    let refused = Levels::new(&map).write(&[], &out).unwrap_err().to_string();
    assert!(refused.contains("new") && refused.ends_with("choose a new folder, or empty it"), "{refused}");
    assert!(out.join(META).exists(), "what was there stays");
}
