//! The pose of one frame against the map: from the last frame's points where motion can be predicted, from a known view where not,
//! then from the local map (Mur-Artal & Tardós, *ORB-SLAM2*, 2017).

use std::sync::Arc;

use nalgebra::Point3;

use crate::geometry::Se3;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::features::matching::Rules;
use crate::tracking::features::projection::{Projection, ProjectionSearch};
use crate::tracking::localisation::pnp::{pose_from_view, similar_keyframes};
use crate::tracking::map::sparse_map::Map;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose::{PoseObservation, PosePrior, median_squared, optimise_pose};
use crate::tracking::solvers::relative_pose::RelativePose;
use crate::tracking::solvers::residual::InlierClass;

/// Search radius around last frame's points, pixels at the finest level, widened in turn until enough are found.
const MOTION_RADII: [f64; 3] = [8.0, 16.0, 32.0];
const MOTION_SEARCH: ProjectionSearch =
    ProjectionSearch { taken: &[], coarser_octaves: 1, rules: Rules { max_distance: 80, ratio: 0.9, check_rotation: true } };
/// Matches that end the widening of the search, and least inliers of its pose.
const MOTION_MATCHES: usize = 40;
const MOTION_INLIERS: usize = 15;
/// Inliers that make it worth to look more closely around a rough pose.
const ROUGH_INLIERS: usize = 8;
/// Search radius around landmarks, pixels at the finest level: seen from about the known direction, and otherwise.
const MAP_RADIUS_STRAIGHT: f64 = 5.0;
const MAP_RADIUS_OBLIQUE: f64 = 8.0;
/// Cosine of the angle up to which a view is straight.
const STRAIGHT_COSINE: f64 = 0.998;
/// The radius grows by this where the pose is rough.
const ROUGH_FACTOR: f64 = 2.5;
const MAP_RULES: Rules = Rules { max_distance: 80, ratio: 0.8, check_rotation: false };
/// The local map: keyframes that see the frame's landmarks, and the neighbours of those that see most.
const LOCAL_KEYFRAMES: usize = 20;
const LOCAL_NEAREST: usize = 5;
/// Inliers from which on landmarks hold a pose that has a prior.
const HELD_INLIERS: usize = 50;
/// Keyframes tried when lost.
const RELOCALISATION_KEYFRAMES: usize = 4;

/// The last frame that has a pose.
#[derive(Clone, Debug)]
pub struct LastFrame {
    pub features: Arc<FrameFeatures>,
    pub camera_from_world: Se3,
    /// The living landmark that each feature shows.
    pub landmarks: Vec<Option<usize>>,
}

/// A frame with its pose found.
#[derive(Clone, Debug)]
pub struct Localised {
    pub camera_from_world: Se3,
    /// The landmark that each feature shows.
    pub landmarks: Vec<Option<usize>>,
    pub inliers: usize,
    /// How many were matched, inliers and outliers.
    pub matches: usize,
    /// Median of their squared pixel residuals, whitened.
    pub median_squared: f64,
    /// Whether the pose came without a prediction.
    pub rough: bool,
    /// What all pixels say of it, where landmarks are few.
    pub prior: Option<PosePrior>,
    /// The same relative to a keyframe, where that is known; `reference` is its name.
    pub relative_pose: Option<RelativePose>,
}

impl Localised {
    /// Whether landmarks hold it, not pixels alone.
    pub fn is_held(&self) -> bool {
        self.prior.is_none() || self.inliers >= HELD_INLIERS
    }
}

/// Features whose points in the world are known (`None` where not), and the landmarks among these.
pub struct View {
    features: Arc<FrameFeatures>,
    points: Vec<Option<Point3<f64>>>,
    landmarks: Vec<Option<usize>>,
}

/// Localisation in a map.
pub struct Context<'a> {
    pub map: &'a mut Map,
    pub rig: &'a Rig,
}

impl Context<'_> {
    /// From a view and a predicted pose: searches ever wider around the view's points until enough is found, and again closely
    /// around where a wide search has led.
    pub fn with_motion_model(&self, frame: &FrameFeatures, view: &View, predicted: &Se3) -> Option<Localised> {
        let mut best: Option<Localised> = None;
        for radius in MOTION_RADII {
            let (mut found, matches) = self.search(frame, view, predicted, radius);
            if radius > MOTION_RADII[0] && found.inliers >= ROUGH_INLIERS {
                let (again, _) = self.search(frame, view, &found.camera_from_world, MOTION_RADII[0]);
                found = if again.inliers > found.inliers { again } else { found };
            }
            let enough = matches >= MOTION_MATCHES && 2 * found.inliers >= matches;
            if best.as_ref().is_none_or(|b| found.inliers > b.inliers) {
                best = Some(found);
            }
            if enough {
                break;
            }
        }
        best.filter(|b| b.inliers >= MOTION_INLIERS)
    }

    /// From a view without a prediction.
    pub fn against_view(&self, frame: &FrameFeatures, view: &View) -> Option<Localised> {
        let rough = pose_from_view(&view.features.features, &view.points, frame, &self.rig.pinhole)?;
        let pairs: Vec<(usize, usize)> = rough.matches.iter().map(|m| (m.query, m.feature)).collect();
        let mut found =
            self.optimise_over(frame, &rough.camera_from_world, None, &pairs, |i| view.points[i], |i| view.landmarks[i]);
        if found.inliers >= ROUGH_INLIERS {
            let (guided, _) = self.search(frame, view, &found.camera_from_world, MOTION_RADII[1]);
            found = if guided.inliers > found.inliers { guided } else { found };
        }
        found.rough = true;
        (found.inliers >= MOTION_INLIERS).then_some(found)
    }

    /// The last frame as a view: its landmarks, and temporary points from depth for its other features.
    pub fn view_of_last(&self, last: &LastFrame) -> View {
        let world_from_camera = last.camera_from_world.inverse();
        let temporary = |i| last.features.point_in_camera(i, self.rig).map(|p| world_from_camera * p);
        let point = |i: usize| last.landmarks[i].map(|l| self.map.position(l)).or_else(|| temporary(i));
        View {
            features: last.features.clone(),
            points: (0..last.features.len()).map(point).collect(),
            landmarks: last.landmarks.clone(),
        }
    }

    /// A keyframe's landmarks as a view.
    pub fn view_of_keyframe(&self, keyframe: usize) -> View {
        let keyframe = &self.map.keyframes[keyframe];
        View {
            features: keyframe.features.clone(),
            points: keyframe.landmarks.iter().map(|l| l.map(|l| self.map.position(l))).collect(),
            landmarks: keyframe.landmarks.clone(),
        }
    }

    /// From the map alone, when lost: `reference` and the keyframes that look most alike; the best of them.
    pub fn relocalise(&mut self, frame: &FrameFeatures, reference: usize) -> Option<Localised> {
        let mut tried = vec![reference];
        tried.extend(similar_keyframes(self.map, frame, RELOCALISATION_KEYFRAMES).into_iter().filter(|k| *k != reference));
        let mut best: Option<Localised> = None;
        for keyframe in tried {
            let Some(rough) = self.against_view(frame, &self.view_of_keyframe(keyframe)) else { continue };
            let found = self.in_local_map(frame, &rough, keyframe);
            if best.as_ref().is_none_or(|b| found.inliers > b.inliers) {
                best = Some(found);
            }
        }
        best
    }

    /// Refines a pose with all landmarks around it.
    pub fn in_local_map(&mut self, frame: &FrameFeatures, start: &Localised, reference: usize) -> Localised {
        let taken: Vec<bool> = start.landmarks.iter().map(Option::is_some).collect();
        let mut pairs: Vec<(usize, usize)> =
            start.landmarks.iter().enumerate().filter_map(|(feature, l)| l.map(|l| (l, feature))).collect();
        let mut matched: Vec<usize> = pairs.iter().map(|(l, _)| *l).collect();
        matched.sort_unstable();
        let mut visible = self.map.visible(self.local_landmarks(start, reference), &start.camera_from_world, self.rig);
        visible.iter().for_each(|p| self.map.landmarks[p.point].observable += 1);
        visible.retain(|p| matched.binary_search(&p.point).is_err());
        let radius = |p: &Projection| {
            let base = if p.view_cosine > STRAIGHT_COSINE { MAP_RADIUS_STRAIGHT } else { MAP_RADIUS_OBLIQUE };
            base * if start.rough { ROUGH_FACTOR } else { 1.0 }
        };
        let search = ProjectionSearch { taken: &taken, coarser_octaves: 0, rules: MAP_RULES };
        let found = search.run(frame, &visible, radius, self.rig);
        pairs.extend(found.iter().map(|m| (m.point, m.feature)));
        let point = |l| Some(self.map.position(l));
        let mut found = self.optimise_over(frame, &start.camera_from_world, start.prior, &pairs, point, Some);
        found.rough = start.rough;
        for l in found.landmarks.iter().flatten() {
            self.map.landmarks[*l].observed += 1;
        }
        found
    }

    /// From a prior, with the landmarks that agree near it.
    pub fn with_prior(&mut self, frame: &FrameFeatures, prior: PosePrior, reference: usize) -> Localised {
        let blank = Localised {
            camera_from_world: prior.camera_from_world,
            landmarks: vec![None; frame.len()],
            inliers: 0,
            matches: 0,
            median_squared: 0.0,
            rough: true,
            prior: Some(prior),
            relative_pose: None,
        };
        self.in_local_map(frame, &blank, reference)
    }

    /// Optimises a pose over pairs (source that `known` knows the point of, feature) and keeps the landmarks that agree.
    fn optimise_over(
        &self,
        frame: &FrameFeatures,
        initial: &Se3,
        prior: Option<PosePrior>,
        pairs: &[(usize, usize)],
        known: impl Fn(usize) -> Option<Point3<f64>>,
        landmark_of: impl Fn(usize) -> Option<usize>,
    ) -> Localised {
        let mut landmarks = vec![None; frame.len()];
        let usable: Vec<(usize, usize, PoseObservation)> = pairs
            .iter()
            .filter_map(|(source, feature)| {
                let measurement = self.rig.measurement(&frame.features[*feature]);
                known(*source).map(|point_in_world| (*source, *feature, PoseObservation { point_in_world, measurement }))
            })
            .collect();
        let observations: Vec<PoseObservation> = usable.iter().map(|u| u.2).collect();
        let estimate = optimise_pose(&self.rig.pinhole, initial, prior.as_ref(), &observations);
        for ((source, feature, _), class) in usable.iter().zip(&estimate.classes) {
            if *class != InlierClass::Outlier {
                landmarks[*feature] = landmark_of(*source);
            }
        }
        Localised {
            camera_from_world: estimate.camera_from_world,
            landmarks,
            inliers: estimate.inliers,
            matches: usable.len(),
            median_squared: median_squared(&self.rig.pinhole, &estimate.camera_from_world, &observations),
            rough: false,
            prior,
            relative_pose: None,
        }
    }

    /// Looks for a view's points around where `pose` shows them, and optimises the pose; also returns the number of matches.
    fn search(&self, frame: &FrameFeatures, view: &View, pose: &Se3, radius: f64) -> (Localised, usize) {
        let pinhole = &self.rig.pinhole;
        let project = |(index, (feature, point)): (usize, (&Feature, &Option<Point3<f64>>))| {
            let p_in_camera = (pose * (*point)?).coords;
            Some(Projection {
                point: index,
                pixel: pinhole.project(&p_in_camera).filter(|p| pinhole.contains(p, 0.0))?,
                octave: feature.octave,
                view_cosine: 1.0,
                inverse_depth: 1.0 / p_in_camera.z,
                descriptor: feature.descriptor,
                angle_rad: feature.angle_rad,
            })
        };
        let projections: Vec<Projection> =
            view.features.features.iter().zip(&view.points).enumerate().filter_map(project).collect();
        let matches = MOTION_SEARCH.run(frame, &projections, |_| radius, self.rig);
        let pairs: Vec<(usize, usize)> = matches.iter().map(|m| (m.point, m.feature)).collect();
        (self.optimise_over(frame, pose, None, &pairs, |i| view.points[i], |i| view.landmarks[i]), matches.len())
    }

    fn local_landmarks(&self, start: &Localised, reference: usize) -> Vec<usize> {
        let observing = self.map.covisibility(start.landmarks.iter().flatten().copied());
        let mut keyframes: Vec<usize> = observing.iter().take(LOCAL_KEYFRAMES).map(|(k, _)| *k).collect();
        if !keyframes.contains(&reference) {
            keyframes.push(reference);
        }
        for (keyframe, _) in observing.iter().take(LOCAL_NEAREST) {
            for neighbour in &self.map.keyframes[*keyframe].neighbours {
                if !keyframes.contains(neighbour) {
                    keyframes.push(*neighbour);
                }
            }
        }
        self.map.landmarks_of(&keyframes)
    }
}
