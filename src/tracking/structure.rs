//! Sparse points of photos with known poses: features are matched along epipolar lines with other views and triangulated, as tracking makes
//! new landmarks.
//!
//! A point needs two other views that agree on its depth. All features are expressed in the pinhole of the first view, so that photos
//! may have different cameras. Left out: refinement of points and poses, and joining what several views see of one point.

use std::sync::Arc;

use nalgebra::{Point3, Vector2, Vector3};
use rayon::prelude::*;

use crate::geometry::{Camera, Pinhole, Se3};
use crate::sequence::{Frame, Sensor};
use crate::tracking::features::frame_features::Feature;
use crate::tracking::front_end::FrontEnd;
use crate::tracking::map::triangulation::{Candidates, MatchedPoint, match_along_lines};
use crate::tracking::rig::Rig;
use crate::tracking::{TrackingConfig, TrackingError};

/// Views that a view is matched with, at most. Their ranks by distance grow geometrically up to the furthest: that suits photos far apart and
/// the frames of a video, whose nearest views have no parallax.
const NEIGHBOURS: usize = 12;
const FURTHEST: usize = 64;
/// Cosine of the angle between optical axes beyond which views are not matched: 60°.
const MIN_AXIS_COSINE: f64 = 0.5;
/// Depths that differ by fewer standard deviations agree.
const AGREEING_SIGMAS: f64 = 2.0;
/// Relative standard deviation of the depth up to which there is a point.
const MAX_DEPTH_ERROR: f64 = 0.1;
/// Views that must agree on a depth, beside the view itself.
const AGREEING: usize = 2;

/// Features of a photo with a known pose.
#[derive(Clone, Debug)]
pub struct PosedView {
    camera_from_world: Se3,
    pinhole: Pinhole,
    /// In this pinhole.
    features: Vec<Feature>,
    /// sRGB, of the features.
    colors: Vec<[u8; 3]>,
}

/// A point that a view sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenPoint {
    /// In the distortion-free pinhole of the view's camera.
    pub pixel: Vector2<f64>,
    /// Along z, in the unit of the poses.
    pub depth: f64,
    /// In the world.
    pub position: Point3<f64>,
    /// sRGB.
    pub color: [u8; 3],
}

impl PosedView {
    /// Extracts the features of a photo.
    ///
    /// # Errors
    /// [`TrackingError`] if OpenCV fails.
    pub fn new(frame: &Frame, camera: &Camera, world_from_camera: &Se3, config: &TrackingConfig) -> Result<Self, TrackingError> {
        let Camera { pinhole, .. } = *camera;
        let extracted = FrontEnd::new(*camera, Sensor::Mono, config).extract(frame)?;
        let features = Arc::unwrap_or_clone(extracted.features).features;
        let color = |feature: &Feature| {
            let at = camera.distort_pixel(&feature.pixel);
            frame.color.get_pixel_checked(at.x.round() as u32, at.y.round() as u32).map_or([0; 3], |pixel| pixel.0)
        };
        let colors = features.iter().map(color).collect();
        Ok(Self { camera_from_world: world_from_camera.inverse(), pinhole, features, colors })
    }

    fn candidates<'a>(&'a self, features: &'a [Feature], rig: &Rig) -> Candidates<'a> {
        Candidates::new(features, 0..features.len(), &self.camera_from_world, rig)
    }

    fn centre(&self) -> Point3<f64> {
        self.camera_from_world.inverse_transform_point(&Point3::origin())
    }

    fn axis(&self) -> Vector3<f64> {
        self.camera_from_world.inverse_transform_vector(&Vector3::z())
    }
}

/// The points that each view sees, in the order of its features.
pub fn triangulate_views(views: &[PosedView], config: &TrackingConfig) -> Vec<Vec<SeenPoint>> {
    let Some(first) = views.first() else { return Vec::new() };
    let rig = Rig::new(first.pinhole, config.clone());
    let features: Vec<Vec<Feature>> = views.iter().map(|view| features_in(view, &rig.pinhole)).collect();
    let candidates: Vec<Candidates<'_>> =
        views.iter().zip(&features).map(|(view, features)| view.candidates(features, &rig)).collect();
    (0..views.len()).into_par_iter().map(|index| points_of(views, &candidates, index, &rig)).collect()
}

/// The features, as a camera of the same pose with another pinhole sees them.
fn features_in(view: &PosedView, pinhole: &Pinhole) -> Vec<Feature> {
    let pixel = |feature: &Feature| {
        let ray = view.pinhole.unproject(&feature.pixel, 1.0);
        Vector2::new(pinhole.fx * ray.x + pinhole.cx, pinhole.fy * ray.y + pinhole.cy)
    };
    view.features.iter().map(|feature| Feature { pixel: pixel(feature), ..*feature }).collect()
}

/// What view `index` sees. `candidates` are the views' features in one pinhole.
fn points_of(views: &[PosedView], candidates: &[Candidates<'_>], index: usize, rig: &Rig) -> Vec<SeenPoint> {
    let view = &views[index];
    let mut depths: Vec<Vec<Depth>> = vec![Vec::new(); view.features.len()];
    for other in neighbours(views, index) {
        for MatchedPoint { mine, point, parallax_cosine, .. } in match_along_lines(&candidates[index], &candidates[other], rig) {
            let sigma_rad = rig.pixel_sigma(view.features[mine].octave) / rig.pinhole.fx;
            depths[mine].push(Depth { z: (view.camera_from_world * point).z, sigma: sigma_rad / parallax_cosine.acos() });
        }
    }
    let world_from_camera = view.camera_from_world.inverse();
    let seen = |((feature, color), depths): ((&Feature, &[u8; 3]), &Vec<Depth>)| {
        let (pixel, depth) = (feature.pixel, agreed(depths)?);
        let position = world_from_camera * Point3::from(view.pinhole.unproject(&pixel, depth));
        Some(SeenPoint { pixel, depth, position, color: *color })
    };
    view.features.iter().zip(&view.colors).zip(&depths).filter_map(seen).collect()
}

/// The views that view `index` is matched with, nearest first.
fn neighbours(views: &[PosedView], index: usize) -> Vec<usize> {
    let (centre, axis) = (views[index].centre(), views[index].axis());
    let alike = |other: &usize| *other != index && views[*other].axis().dot(&axis) > MIN_AXIS_COSINE;
    let mut ranked: Vec<(f64, usize)> =
        (0..views.len()).filter(alike).map(|other| ((views[other].centre() - centre).norm(), other)).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let furthest = ranked.len().min(FURTHEST) as f64;
    let mut ranks: Vec<usize> =
        (0..NEIGHBOURS).map(|k| furthest.powf(k as f64 / (NEIGHBOURS - 1) as f64).round() as usize).collect();
    ranks.dedup();
    ranks.iter().filter_map(|rank| ranked.get(rank.checked_sub(1)?)).map(|(_, other)| *other).collect()
}

/// A depth by one other view.
#[derive(Clone, Copy, Debug)]
struct Depth {
    z: f64,
    /// Standard deviation as a share of the depth.
    sigma: f64,
}

impl Depth {
    fn agrees(&self, other: &Self) -> bool {
        (self.z - other.z).abs() < AGREEING_SIGMAS * self.sigma.hypot(other.sigma) * self.z.min(other.z)
    }
}

/// The most certain of the depths that agree with the depth with which most agree; `None` if too few do, or it is not certain.
fn agreed(depths: &[Depth]) -> Option<f64> {
    let agreeing = |depth: &Depth| depths.iter().copied().filter(|other| depth.agrees(other)).collect::<Vec<Depth>>();
    let group = depths.iter().map(agreeing).max_by_key(Vec::len).filter(|group| group.len() >= AGREEING)?;
    let best = group.into_iter().min_by(|a, b| a.sigma.total_cmp(&b.sigma))?;
    (best.sigma < MAX_DEPTH_ERROR).then_some(best.z)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::geometry::se3;
    use crate::tracking::features::descriptor::Descriptor;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    const POINTS: usize = 150;

    /// Views of random points, each with its own descriptor, from along a line; every second one by a camera of another focal length. A
    /// tenth of the features show something else.
    fn views(count: usize) -> (Vec<PosedView>, Vec<Point3<f64>>) {
        let mut random = fastrand::Rng::with_seed(11);
        let mut between = |low: f64, high: f64| low + (high - low) * random.f64();
        let points: Vec<Point3<f64>> =
            (0..POINTS).map(|_| Point3::new(between(-1.0, 1.0), between(-0.8, 0.8), between(2.0, 5.0))).collect();
        let mut random = fastrand::Rng::with_seed(12);
        let descriptors: Vec<Descriptor> = points.iter().map(|_| Descriptor(std::array::from_fn(|_| random.u64(..)))).collect();
        let view = |k: usize| {
            let along = 0.15 * k as f64;
            let camera_from_world = se3::exp(&Vector6::new(-along, 0.02 * along, 0.0, 0.0, 0.03 * along, 0.0));
            let pinhole = if k.is_multiple_of(2) { PINHOLE } else { Pinhole { fx: 460.0, cx: 300.0, ..PINHOLE } };
            let shown = |i: usize| {
                let pixel = pinhole.project(&(camera_from_world * points[i]).coords).unwrap();
                let wrong = (i + 7 * k).is_multiple_of(10);
                feature(pixel.x, pixel.y + if wrong { 25.0 } else { 0.0 }, descriptors[i])
            };
            let features = (0..POINTS).map(shown).collect();
            PosedView { camera_from_world, pinhole, features, colors: vec![[k as u8; 3]; POINTS] }
        };
        ((0..count).map(view).collect(), points)
    }

    #[test]
    fn points_are_where_three_views_see_them() {
        let (views, points) = views(6);
        let seen = triangulate_views(&views, &TrackingConfig::default());
        for (k, (view, seen)) in views.iter().zip(&seen).enumerate() {
            assert!(seen.len() > POINTS * 7 / 10, "view {k} sees {}", seen.len());
            for point in seen {
                let apart = points.iter().map(|truth| (truth - point.position).norm()).fold(f64::INFINITY, f64::min);
                let in_camera = view.camera_from_world * point.position;
                assert!(apart < 1e-6 && (in_camera.z - point.depth).abs() < 1e-9, "view {k} sees {point:?}");
                assert!((view.pinhole.project(&in_camera.coords).unwrap() - point.pixel).norm() < 1e-6);
                assert_eq!(point.color, [k as u8; 3]);
            }
        }
    }

    #[test]
    fn two_views_or_views_without_parallax_give_no_points() {
        let (mut views, _) = views(6);
        let points = |views: &[PosedView]| triangulate_views(views, &TrackingConfig::default()).concat().len();
        assert_eq!((points(&views[..2]), points(&[])), (0, 0));
        let first = views[0].clone();
        views.iter_mut().for_each(|view| *view = first.clone());
        assert_eq!(points(&views), 0);
    }

    #[test]
    fn the_most_certain_depth_of_the_majority_is_taken() {
        let agreed = |depths: &[(f64, f64)]| agreed(&depths.iter().map(|&(z, sigma)| Depth { z, sigma }).collect::<Vec<_>>());
        assert_eq!(agreed(&[(2.0, 0.05), (5.0, 0.01), (2.1, 0.03), (1.99, 0.02)]), Some(1.99));
        assert_eq!(agreed(&[(2.0, 0.01), (2.1, 0.01), (5.0, 0.01)]), None, "none agree");
        assert_eq!(agreed(&[(2.0, 0.2), (2.1, 0.2)]), None, "it may be anywhere");
        assert_eq!((agreed(&[(2.0, 0.01)]), agreed(&[])), (None, None));
    }
}
