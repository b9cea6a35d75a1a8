//! Loop detection: finds a place that a new keyframe shows again, verifies it, and estimates the corrected pose (after Mur-Artal, Montiel & Tardós, *ORB-SLAM*, 2015, sec. VII, and Campos et al.,
//! *ORB-SLAM3*, 2021, sec. VI, whose idea it is to confirm a loop by the keyframe's neighbours at once instead of waiting).
//!
//! A false loop ruins a map and a missed one only leaves its drift, so each step may refuse: the place must resemble the keyframe about
//! as much as its own neighbours do, the landmarks must align rigidly, most of what should be seen must be seen, neighbours or all pixels
//! must agree, and the correction must be one that drift can explain.

use nalgebra::Point3;

use crate::geometry::{Se3, Sim3};
use crate::tracking::features::matching::{Rules, match_all};
use crate::tracking::features::projection::{PointMatch, ProjectionSearch};
use crate::tracking::localisation::dense_alignment::align;
use crate::tracking::map::sparse_map::{Keyframe, Map};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose::{PoseObservation, PosePrior, optimise_pose};
use crate::tracking::solvers::residual::InlierClass;
use crate::tracking::solvers::sim3_alignment::{Pair, align_pairs};

/// Least keyframes between a place and its return.
const MIN_AGE: usize = 10;
/// Keyframes that share this many landmarks need no loop closed between them.
pub const CONNECTED_SHARED: usize = 15;
/// A place must resemble the keyframe this much in relation to its most similar neighbour.
const MIN_SCORE_SHARE: f64 = 0.25;
const MAX_CANDIDATES: usize = 3;
const MATCH_RULES: Rules = Rules { max_distance: 50, ratio: 0.85, check_rotation: true };
/// Keyframes around the place whose landmarks are looked for.
const PLACE_NEIGHBOURS: usize = 8;
/// Search radius around the place's landmarks, pixels at the finest level.
const PROJECTION_RADIUS: f64 = 6.0;
const PROJECTION_SEARCH: ProjectionSearch =
    ProjectionSearch { taken: &[], coarser_octaves: 1, rules: Rules { max_distance: 60, ratio: 0.9, check_rotation: false } };
/// Landmarks of the place that the keyframe and the neighbours that confirm it must show: each, together, and together as a share of what they
/// should show.
const MIN_INLIERS_EACH: usize = 20;
const MIN_INLIERS: usize = 90;
const MIN_FOUND_SHARE: f64 = 0.1;
/// Share of the place's pixels that must agree, where pixels confirm it instead of neighbours.
const MIN_OVERLAP: f64 = 0.5;
/// Neighbours of the keyframe that are searched for the place, and how many of them must confirm it.
const NEIGHBOURS_SEARCHED: usize = 4;
const NEIGHBOURS_CONFIRMING: usize = 2;
/// Largest plausible drift: metres a metre of path, radians a radian of rotation, and constant parts; the
/// scale within this factor.
const MAX_DRIFT_SHARE: f64 = 0.15;
const DRIFT_METRES: f64 = 0.1;
const DRIFT_RAD: f64 = 0.1;
const MAX_SCALE_DRIFT: f64 = 2.0;
/// A correction so many times as large as drift can explain is of another place.
const REPETITION: f64 = 2.0;

/// A place that was recognised and made sure of.
#[derive(Clone, Debug)]
pub struct Recognised {
    /// The keyframe that shows it, and the old keyframe that showed it first.
    pub keyframe: usize,
    pub place: usize,
    /// Where the keyframe ought to be: camera_from_world, its unit being that in which the keyframe is now.
    pub corrected: Sim3,
    /// The place's landmarks, and the keyframe's features that show them.
    pub matches: Vec<(usize, usize)>,
    /// All landmarks around the place.
    pub landmarks: Vec<usize>,
}

/// Where a keyframe ought to be, as in [`Recognised::corrected`], and the landmarks of the place with the features that show them.
type Confirmed = (Sim3, Vec<(usize, usize)>);

/// Whether depth was measured: then lengths cannot drift.
pub fn knows_scale(map: &Map) -> bool {
    map.keyframes.first().is_some_and(|k| k.features.features.iter().any(|f| f.depth_metres.is_some()))
}

/// Loop detection in a map.
pub struct Search<'a> {
    pub map: &'a Map,
    pub rig: &'a Rig,
    pub scale_is_free: bool,
}

impl Search<'_> {
    /// Old keyframes that resemble `keyframe` and are not connected with it, best first or nearest first, one of each place.
    pub fn candidates(&self, keyframe: usize, nearest_first: bool) -> Vec<usize> {
        let connected = self.connected(keyframe);
        let is_connected = |k: usize| k == keyframe || connected.contains(&k);
        let ranked = self.map.database.query(&self.map.keyframes[keyframe].features.features);
        let neighbour = ranked.iter().find(|r| r.keyframe != keyframe && is_connected(r.keyframe));
        let least = MIN_SCORE_SHARE * neighbour.map_or(0.0, |r| r.score);
        let mut old: Vec<usize> = ranked
            .iter()
            .filter(|r| r.score >= least && !is_connected(r.keyframe) && self.is_old(r.keyframe, keyframe))
            .map(|r| r.keyframe)
            .collect();
        if nearest_first {
            let here = self.map.keyframes[keyframe].centre();
            old.sort_by(|a, b| {
                (self.map.keyframes[*a].centre() - here).norm().total_cmp(&(self.map.keyframes[*b].centre() - here).norm())
            });
        }
        let (mut chosen, mut places): (Vec<usize>, Vec<usize>) = (Vec::new(), Vec::new());
        for place in old {
            if chosen.len() == MAX_CANDIDATES {
                break;
            }
            if !places.contains(&place) {
                places.extend(self.connected(place));
                chosen.push(place);
            }
        }
        chosen
    }

    /// Whether a keyframe shows another place than `keyframe` as far as the map knows: long before it, or in another submap.
    fn is_old(&self, other: usize, keyframe: usize) -> bool {
        other + MIN_AGE <= keyframe || !self.map.connects(other, keyframe)
    }

    /// Keyframes that share enough landmarks with a keyframe, strongest first.
    fn connected(&self, keyframe: usize) -> Vec<usize> {
        let shared = self.map.covisible(keyframe).into_iter();
        shared.take_while(|(_, shared)| *shared >= CONNECTED_SHARED).map(|(k, _)| k).collect()
    }

    /// Makes sure that `keyframe` shows `place`, or a place that looks just like it.
    pub fn recognise(&self, keyframe: usize, place: usize) -> Option<Recognised> {
        let aligned = self.align(keyframe, place);
        let has_pixels = [keyframe, place].iter().all(|k| self.map.keyframes[*k].dense.is_some());
        if aligned.is_none() && !has_pixels {
            return None;
        }
        let mut around = vec![place];
        around.extend(self.connected(place).into_iter().filter(|k| self.is_old(*k, keyframe)).take(PLACE_NEIGHBOURS));
        let landmarks = self.map.landmarks_of(&around);
        let by_neighbours = aligned.and_then(|aligned| self.confirm_by_neighbours(keyframe, place, &landmarks, &aligned));
        let (corrected, matches) = by_neighbours.or_else(|| self.confirm_by_pixels(keyframe, place, &landmarks, aligned))?;
        Some(Recognised { keyframe, place, corrected, matches, landmarks })
    }

    /// Confirms a place if the keyframe's neighbours show it too. `aligned` is keyframe_from_place.
    fn confirm_by_neighbours(&self, keyframe: usize, place: usize, landmarks: &[usize], aligned: &Sim3) -> Option<Confirmed> {
        let rough = *aligned * Sim3::from(self.map.keyframes[place].camera_from_world);
        let seen = self.search_in(landmarks, keyframe, &rough.to_rigid(), None);
        if seen.matches.len() < MIN_INLIERS_EACH {
            return None;
        }
        let current = self.map.keyframes[keyframe].camera_from_world;
        let in_neighbour = |neighbour: &usize| {
            let neighbour_from_keyframe = self.map.keyframes[*neighbour].camera_from_world * current.inverse();
            // The neighbours' motion in the place's unit.
            let mut motion = neighbour_from_keyframe;
            motion.translation.vector /= rough.scale;
            self.search_in(landmarks, *neighbour, &(motion * seen.camera_from_world), None)
        };
        let mut confirming: Vec<Seen> = self.connected(keyframe).iter().take(NEIGHBOURS_SEARCHED).map(in_neighbour).collect();
        confirming.sort_by_key(|seen| std::cmp::Reverse(seen.matches.len()));
        confirming.truncate(NEIGHBOURS_CONFIRMING);
        let views = || confirming.iter().chain([&seen]);
        let found: usize = views().map(|seen| seen.matches.len()).sum();
        let expected: usize = views().map(|seen| seen.expected).sum();
        let confirmed = confirming.len() == NEIGHBOURS_CONFIRMING
            && views().all(|seen| seen.matches.len() >= MIN_INLIERS_EACH)
            && found >= MIN_INLIERS
            && found as f64 >= MIN_FOUND_SHARE * expected as f64;
        let corrected = Sim3 {
            rotation: seen.camera_from_world.rotation,
            translation: seen.camera_from_world.translation.vector * rough.scale,
            scale: rough.scale,
        };
        confirmed.then_some((corrected, seen.matches))
    }

    /// Confirms a place that shows few landmarks if all pixels agree with these: those of a wall fit elsewhere too, and so do a few landmarks.
    fn confirm_by_pixels(&self, keyframe: usize, place: usize, landmarks: &[usize], aligned: Option<Sim3>) -> Option<Confirmed> {
        let (here, there) = (&self.map.keyframes[keyframe], &self.map.keyframes[place]);
        let (now, before) = (here.dense.as_ref()?, there.dense.as_ref()?);
        let guesses = aligned.map(|aligned| aligned.to_rigid()).into_iter().chain([Se3::identity()]);
        let seen_from = |guess: Se3| {
            let prior =
                align(before, now, &[guess]).filter(|found| found.overlap >= MIN_OVERLAP)?.prior(&there.camera_from_world);
            let seen = self.search_in(landmarks, keyframe, &prior.camera_from_world, Some(&prior));
            let found = seen.matches.len();
            let enough = found >= MIN_INLIERS_EACH && found as f64 >= MIN_FOUND_SHARE * seen.expected as f64;
            enough.then(|| (Sim3::from(seen.camera_from_world), seen.matches))
        };
        guesses.filter_map(seen_from).next()
    }

    /// The point that a feature shows: its landmark, or where its depth was measured.
    fn point_in_camera(&self, keyframe: &Keyframe, feature: usize) -> Option<Point3<f64>> {
        let landmark = keyframe.landmarks[feature].map(|l| keyframe.camera_from_world * self.map.position(l));
        landmark.or_else(|| keyframe.features.point_in_camera(feature, self.rig))
    }

    /// keyframe_from_place, from features that match and whose points are known.
    fn align(&self, keyframe: usize, place: usize) -> Option<Sim3> {
        let (a, b) = (&self.map.keyframes[keyframe], &self.map.keyframes[place]);
        let points: Vec<Option<Point3<f64>>> = (0..a.features.len()).map(|i| self.point_in_camera(a, i)).collect();
        let known: Vec<bool> = points.iter().map(Option::is_some).collect();
        let matches = match_all(&a.features.features, &known, &b.features.features, &MATCH_RULES);
        let pair = |(i, j): (usize, usize)| {
            Some(Pair {
                p_in_a: points[i]?,
                p_in_b: self.point_in_camera(b, j)?,
                in_a: self.rig.measurement(&a.features.features[i]),
                in_b: self.rig.measurement(&b.features.features[j]),
            })
        };
        let pairs: Vec<Pair> = matches.iter().filter_map(|m| pair((m.query, m.feature))).collect();
        align_pairs(&pairs, &self.rig.pinhole, self.scale_is_free)
    }

    /// Looks for landmarks in a keyframe as if it were at `camera_from_world`, and improves that pose by what it finds.
    fn search_in(&self, landmarks: &[usize], keyframe: usize, camera_from_world: &Se3, prior: Option<&PosePrior>) -> Seen {
        let features = &self.map.keyframes[keyframe].features;
        let visible = self.map.visible(landmarks.iter().copied(), camera_from_world, self.rig);
        let found = PROJECTION_SEARCH.run(features, &visible, |_| PROJECTION_RADIUS, self.rig);
        let observation = |m: &PointMatch| PoseObservation {
            point_in_world: self.map.position(m.point),
            measurement: self.rig.measurement(&features.features[m.feature]),
        };
        let observations: Vec<PoseObservation> = found.iter().map(observation).collect();
        let estimate = optimise_pose(&self.rig.pinhole, camera_from_world, prior, &observations);
        let good = found.iter().zip(&estimate.classes).filter(|(_, class)| **class != InlierClass::Outlier);
        let matches = good.map(|(m, _)| (m.point, m.feature)).collect();
        Seen { camera_from_world: estimate.camera_from_world, matches, expected: visible.len() }
    }

    /// How drift on the way from the place to the keyframe explains the correction. Nothing is known of the way between submaps.
    pub fn plausibility(&self, found: &Recognised) -> Plausibility {
        let Recognised { keyframe, place, corrected, .. } = found;
        if !self.map.connects(*keyframe, *place) {
            return Plausibility::Drift;
        }
        let (here, there) = (&self.map.keyframes[*keyframe], &self.map.keyframes[*place]);
        let path_metres = (here.travelled.metres - there.travelled.metres).abs();
        let rotation_rad = (here.travelled.radians - there.travelled.radians).abs();
        let off = corrected.to_rigid().inverse() * here.camera_from_world;
        let grown = corrected.scale.max(1.0 / corrected.scale);
        let most_metres = DRIFT_METRES + MAX_DRIFT_SHARE * path_metres;
        let turns_and_grows = off.rotation.angle() <= DRIFT_RAD + MAX_DRIFT_SHARE * rotation_rad && grown <= MAX_SCALE_DRIFT;
        match self.shift_metres(found) / most_metres {
            share if share <= 1.0 && turns_and_grows => Plausibility::Drift,
            share if share > REPETITION && turns_and_grows => Plausibility::Repetition,
            _ => Plausibility::None,
        }
    }

    /// How far the correction moves the keyframe, metres.
    pub fn shift_metres(&self, found: &Recognised) -> f64 {
        let corrected = Point3::from(found.corrected.to_rigid().inverse().translation.vector);
        (self.map.keyframes[found.keyframe].centre() - corrected).norm()
    }
}

/// What can explain a recognised place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Plausibility {
    /// The camera is back, and its pose has drifted.
    Drift,
    /// Another place looks like it, further away than drift can lead.
    Repetition,
    None,
}

/// Landmarks found in a keyframe.
struct Seen {
    camera_from_world: Se3,
    /// Landmark and feature.
    matches: Vec<(usize, usize)>,
    /// Landmarks that should be in the image.
    expected: usize,
}
