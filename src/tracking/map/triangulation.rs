//! New landmarks from two views: features that show no landmark yet are matched along epipolar lines and triangulated
//! (Mur-Artal, Montiel & Tardós, *ORB-SLAM*, IEEE T-RO 2015, sec. VI-C). For cameras without depth, and for what depth does not reach.

use nalgebra::{Point3, Vector2, Vector3};

use crate::geometry::{Pinhole, Se3};
use crate::tracking::features::frame_features::Feature;
use crate::tracking::map::sparse_map::{Keyframe, Map, Observation};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::epipolar::fundamental;
use crate::tracking::solvers::residual::InlierClass;

/// Keyframes that a new one is matched with.
const NEIGHBOURS: usize = 10;
/// Two views must be this share of the scene's median depth apart.
const MIN_BASELINE_SHARE: f64 = 0.01;
const MAX_DISTANCE: u32 = 50;
/// The best must be below this share of the second best.
const RATIO: f32 = 0.9;
/// Squared distance from the epipolar line, in standard deviations (χ², 1 degree of freedom, 95%).
const CHI2_LINE: f64 = 3.841;
/// Cosine of the parallax that a point needs: about 1.1°.
const MAX_PARALLAX_COSINE: f64 = 0.9998;
/// How much the ratio of distances may differ from the ratio of sizes at which the pyramid found the two features.
const SIZE_SLACK: f64 = 1.8;

/// A camera with its pose, for rays and projections.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    pub camera_from_world: &'a Se3,
    pub pinhole: &'a Pinhole,
}

impl View<'_> {
    fn centre(&self) -> Point3<f64> {
        self.camera_from_world.inverse_transform_point(&Point3::origin())
    }

    /// Direction of a pixel's line of sight in the world, unit length.
    fn ray(&self, pixel: &Vector2<f64>) -> Vector3<f64> {
        self.camera_from_world.rotation.inverse() * self.pinhole.unproject(pixel, 1.0).normalize()
    }
}

/// A point between two lines of sight.
#[derive(Clone, Copy, Debug)]
pub struct Triangulated {
    pub point: Point3<f64>,
    /// Cosine of the angle at which the lines meet.
    pub parallax_cosine: f64,
}

/// The point nearest to two lines of sight; `None` where they are parallel or it lies behind a camera.
pub fn triangulate(a: &View<'_>, at_a: &Vector2<f64>, b: &View<'_>, at_b: &Vector2<f64>) -> Option<Triangulated> {
    let (from_a, from_b) = (a.centre(), b.centre());
    let (ray_a, ray_b) = (a.ray(at_a), b.ray(at_b));
    let cosine = ray_a.dot(&ray_b);
    let apart = from_b - from_a;
    let spread = 1.0 - cosine * cosine;
    if spread < 1e-12 {
        return None;
    }
    let along_a = (apart.dot(&ray_a) - cosine * apart.dot(&ray_b)) / spread;
    let along_b = (cosine * apart.dot(&ray_a) - apart.dot(&ray_b)) / spread;
    // NaN is not in front.
    let in_front = along_a > 0.0 && along_b > 0.0;
    let point = Point3::from((from_a.coords + ray_a * along_a + from_b.coords + ray_b * along_b) * 0.5);
    in_front.then_some(Triangulated { point, parallax_cosine: cosine })
}

/// Features of a view with a known pose, and which of them to match.
#[derive(Clone, Debug)]
pub struct Candidates<'a> {
    features: &'a [Feature],
    /// A search reads them in a row.
    wanted: Vec<Candidate>,
    camera_from_world: &'a Se3,
}

/// A feature to be matched.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    index: usize,
    pixel: Vector2<f64>,
    /// Squared distance from its epipolar line up to which it may lie on it, pixels².
    slack: f64,
    octave: u8,
}

impl<'a> Candidates<'a> {
    /// Features by their indices.
    pub fn new(features: &'a [Feature], wanted: impl Iterator<Item = usize>, camera_from_world: &'a Se3, rig: &Rig) -> Self {
        let candidate = |index: usize| {
            let Feature { pixel, octave, .. } = features[index];
            let sigma = rig.pixel_sigma(octave);
            Candidate { index, pixel, slack: CHI2_LINE * sigma * sigma, octave }
        };
        Self { features, wanted: wanted.map(candidate).collect(), camera_from_world }
    }

    /// The features of a keyframe that show no landmark yet.
    fn free(keyframe: &'a Keyframe, rig: &Rig) -> Self {
        let free = (0..keyframe.features.len()).filter(|feature| keyframe.landmarks[*feature].is_none());
        Self::new(&keyframe.features.features, free, &keyframe.camera_from_world, rig)
    }

    fn view<'b>(&'b self, pinhole: &'b Pinhole) -> View<'b> {
        View { camera_from_world: self.camera_from_world, pinhole }
    }
}

/// Two features that show one point.
#[derive(Clone, Copy, Debug)]
pub struct MatchedPoint {
    /// Feature of the first view.
    pub mine: usize,
    /// Feature of the second view.
    pub theirs: usize,
    pub point: Point3<f64>,
    /// Cosine of the angle between the two lines of sight.
    pub parallax_cosine: f64,
}

/// Makes landmarks of what `keyframe` and the keyframes that share most with it see, and no landmark shows yet. Returns how many.
pub fn triangulate_with_neighbours(map: &mut Map, keyframe: usize, rig: &Rig) -> usize {
    let config = &rig.config;
    let neighbours: Vec<usize> = map.covisible(keyframe).into_iter().take(NEIGHBOURS).map(|(k, _)| k).collect();
    let mut made = 0;
    for neighbour in neighbours {
        let (this, other) = (&map.keyframes[keyframe], &map.keyframes[neighbour]);
        let depth = map.median_depth(neighbour).unwrap_or(1.0);
        if (this.centre() - other.centre()).norm() < MIN_BASELINE_SHARE * depth {
            continue;
        }
        let (this, other) = (Candidates::free(this, rig), Candidates::free(other, rig));
        for MatchedPoint { mine, theirs, point, .. } in match_along_lines(&this, &other, rig) {
            let landmark = map.add_landmark(Observation { keyframe, feature: mine }, point, config);
            map.add_observation(landmark, Observation { keyframe: neighbour, feature: theirs });
            map.refresh_geometry(landmark, config);
            made += 1;
        }
    }
    made
}

/// Pairs of the wanted features that show one point; each feature at most once.
pub fn match_along_lines(this: &Candidates<'_>, other: &Candidates<'_>, rig: &Rig) -> Vec<MatchedPoint> {
    let pinhole = &rig.pinhole;
    let line_of = fundamental(&(other.camera_from_world * this.camera_from_world.inverse()), pinhole);
    let mut taken: Vec<Option<(u32, MatchedPoint)>> = vec![None; other.features.len()];
    for &Candidate { index: mine, .. } in &this.wanted {
        let feature = &this.features[mine];
        let line = line_of * feature.pixel.push(1.0);
        let Some((theirs, distance)) = best_on_line(feature, &line, other) else { continue };
        let found = &other.features[theirs];
        let Some(met) = triangulate(&this.view(pinhole), &feature.pixel, &other.view(pinhole), &found.pixel) else { continue };
        let agrees = met.parallax_cosine < MAX_PARALLAX_COSINE && {
            let mine = Observed { feature, view: this.view(pinhole) };
            agree(&met.point, &mine, &Observed { feature: found, view: other.view(pinhole) }, rig)
        };
        if agrees && taken[theirs].is_none_or(|(d, _)| distance < d) {
            let Triangulated { point, parallax_cosine } = met;
            taken[theirs] = Some((distance, MatchedPoint { mine, theirs, point, parallax_cosine }));
        }
    }
    taken.into_iter().flatten().map(|(_, matched)| matched).collect()
}

/// The feature of `other` near the line whose descriptor is clearly the most similar.
fn best_on_line(feature: &Feature, line: &Vector3<f64>, other: &Candidates<'_>) -> Option<(usize, u32)> {
    let norm_squared = line.x * line.x + line.y * line.y;
    let (mut best, mut second) = (None::<(usize, u32)>, u32::MAX);
    for Candidate { index, pixel, slack, octave } in &other.wanted {
        let off = line.x * pixel.x + line.y * pixel.y + line.z;
        let near = off * off <= slack * norm_squared;
        if !near || octave.abs_diff(feature.octave) > 2 {
            continue;
        }
        let distance = other.features[*index].descriptor.distance(&feature.descriptor);
        match best {
            Some((_, least)) if distance >= least => second = second.min(distance),
            _ => {
                second = best.map_or(u32::MAX, |(_, least)| least);
                best = Some((*index, distance));
            }
        }
    }
    best.filter(|(_, distance)| *distance <= MAX_DISTANCE && *distance as f32 <= RATIO * second as f32)
}

/// A feature of a view.
struct Observed<'a> {
    feature: &'a Feature,
    view: View<'a>,
}

/// Whether a point projects to both features, at distances that fit their sizes.
fn agree(point: &Point3<f64>, a: &Observed<'_>, b: &Observed<'_>, rig: &Rig) -> bool {
    let projects = |Observed { feature, view }: &Observed<'_>| {
        let class = rig.measurement(feature).classify(view.pinhole, &(view.camera_from_world * point).coords);
        class == InlierClass::Full || (class == InlierClass::PixelOnly && feature.depth_metres.is_none())
    };
    let size = |Observed { feature, view }: &Observed<'_>| (point - view.centre()).norm() / rig.octave_scale(feature.octave);
    let ratio = size(a) / size(b);
    projects(a) && projects(b) && ratio < SIZE_SLACK && ratio > 1.0 / SIZE_SLACK
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::Vector6;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn points_are_found_again_and_lie_on_their_lines(
            x in -1.0f64..1.0, y in -0.8f64..0.8, z in 1.5f64..6.0, tau in prop::array::uniform6(-0.3f64..0.3)
        ) {
            let (a, b) = (Se3::identity(), se3::exp(&Vector6::from(tau)));
            let point = Point3::new(x, y, z);
            let seen = |pose: &Se3| PINHOLE.project(&(pose * point).coords);
            let (Some(at_a), Some(at_b)) = (seen(&a), seen(&b)) else { return Ok(()) };
            let line = fundamental(&b, &PINHOLE) * at_a.push(1.0);
            let off = line.dot(&at_b.push(1.0)) / line.xy().norm().max(1e-9);
            prop_assert!(off.abs() < 1e-6, "{off} pixels off the line");
            let view = |camera_from_world| View { camera_from_world, pinhole: &PINHOLE };
            let Some(met) = triangulate(&view(&a), &at_a, &view(&b), &at_b) else { return Ok(()) };
            if met.parallax_cosine < MAX_PARALLAX_COSINE {
                prop_assert!((met.point - point).norm() < 1e-6);
            }
        }
    }
}
