//! What a closed loop does to the map: the drift is spread over the keyframes by a pose graph, landmarks follow the keyframe that saw
//! them first, and what turned out to be the same is joined (Mur-Artal, Montiel & Tardós, *ORB-SLAM*, 2015: the *essential graph*). The
//! bundle adjustment that settles the rest is up to the caller.

use crate::geometry::sim3::Vector7;
use crate::geometry::{Se3, Sim3};
use crate::tracking::TrackingConfig;
use crate::tracking::loop_closing::detection::{CONNECTED_SHARED, Recognised};
use crate::tracking::map::insertion::fuse;
use crate::tracking::map::sparse_map::{Map, Observation};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose_graph::{Edge, PoseGraph};

/// Keyframes that share this many landmarks are held to their relative pose, besides each one and the one it shares most with.
const STRONG_SHARED: usize = 100;
/// Standard deviation of the relative pose of two keyframes that share [`STRONG_SHARED`] landmarks, metres at a metre's distance and
/// radians, and of the logarithm of their scales. Only their ratios matter, and how they compare with [`HUBER_SIGMAS`].
const SIGMA_TRANSLATION: f64 = 0.003;
const SIGMA_ROTATION_RAD: f64 = 0.002;
const SIGMA_SCALE: f64 = 0.005;
/// Loops that disagree by more than this many standard deviations pull less and less.
const HUBER_SIGMAS: f64 = 10.0;
const GRAPH_STEPS: usize = 30;
/// Neighbours of the keyframe in which the place's landmarks are joined with theirs.
const FUSED_NEIGHBOURS: usize = 10;

/// A keyframe after a correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovedKeyframe {
    /// Its id.
    pub keyframe: usize,
    /// Factor by which lengths around it have grown.
    pub growth: f64,
}

/// A correction of the map: made of it, solved beside tracking, and taken into the map, which has gone on meanwhile.
#[derive(Clone, Debug)]
pub struct Correction {
    found: Recognised,
    /// A pose for each keyframe, and the poses before.
    keyframes: Vec<usize>,
    before: Vec<Se3>,
    graph: PoseGraph,
    /// Keyframes in the map when it was made.
    known: usize,
}

impl Correction {
    /// Spreads the drift that a loop shows over its submap; `edges` are those of all loops, this one's the last. The earlier ones hold their keyframes
    /// as they are.
    pub fn of_loop(map: &Map, found: Recognised, edges: &[Edge], scale_is_free: bool) -> Self {
        let keyframes: Vec<usize> = map.living_in(map.keyframes[found.keyframe].root).collect();
        let before: Vec<Se3> = keyframes.iter().map(|k| map.keyframes[*k].camera_from_world).collect();
        let depth = depth_around(map, found.keyframe);
        let place = |k: usize| keyframes.binary_search(&map.living(k)).ok();
        let mut graph = PoseGraph { poses: before.iter().map(|p| Sim3::from(*p)).collect(), edges: Vec::new(), scale_is_free };
        for (a, keyframe) in keyframes.iter().enumerate().skip(1) {
            let mut older: Vec<(usize, usize)> = Vec::new();
            for (other, shared) in &map.keyframes[*keyframe].links {
                // What a culled keyframe shared, the one that carries it shares.
                let link = place(*other).filter(|b| *b < a && older.iter().all(|(known, _)| known != b));
                older.extend(link.map(|b| (b, *shared)));
            }
            let parent = older.first().copied().unwrap_or((a - 1, 1));
            let strong = older.into_iter().skip(1).filter(|(_, shared)| *shared >= STRONG_SHARED);
            for (b, shared) in std::iter::once(parent).chain(strong) {
                graph.edges.push(edge(a, b, Sim3::from(before[a] * before[b].inverse()), shared, depth));
            }
        }
        // Edges of other submaps have no place. What earlier loops measured, bundle adjustment has improved since: they keep what it found.
        for (k, edge) in edges.iter().enumerate() {
            let Some((a, b)) = place(edge.a).zip(place(edge.b)) else { continue };
            let is_new = k + 1 == edges.len();
            let a_from_b = if is_new { edge.a_from_b } else { Sim3::from(before[a] * before[b].inverse()) };
            graph.edges.push(Edge { a, b, a_from_b, ..*edge });
        }
        Self { found, keyframes, before, graph, known: map.keyframes.len() }
    }

    /// Makes one submap of two that show the same place: the younger moves as a whole to where the older shows it.
    pub fn of_submaps(map: &mut Map, found: Recognised) -> Self {
        let (current, place) = (map.keyframes[found.keyframe].root, map.keyframes[found.place].root);
        // Where the place's submap lies in that of the keyframe.
        let current_from_place = Sim3::from(map.keyframes[found.keyframe].camera_from_world).inverse() * found.corrected;
        let (older, younger) = (current.min(place), current.max(place));
        let younger_from_older = if younger == current { current_from_place } else { current_from_place.inverse() };
        let keyframes: Vec<usize> = map.living_in(younger).collect();
        let before: Vec<Se3> = keyframes.iter().map(|k| map.keyframes[*k].camera_from_world).collect();
        let poses = before.iter().map(|p| Sim3::from(*p) * younger_from_older).collect();
        for keyframe in map.keyframes.iter_mut().filter(|k| k.root == younger) {
            keyframe.root = older;
        }
        map.roots.remove(&younger);
        Self { found, keyframes, before, graph: PoseGraph { poses, ..Default::default() }, known: map.keyframes.len() }
    }

    /// Whether there is nothing to solve.
    pub fn is_solved(&self) -> bool {
        self.graph.edges.is_empty()
    }

    /// Number of keyframes in the pose graph.
    pub fn size(&self) -> usize {
        self.keyframes.len()
    }

    /// Optimises the pose graph.
    pub fn solve(&mut self) {
        self.graph.optimise(GRAPH_STEPS);
    }

    /// Takes the result into the map; `edges` follow what they were measured in. Keyframes that came since go with the newest of those
    /// before. Returns the keyframes that may have moved, in ascending order.
    pub fn apply(&self, map: &mut Map, edges: &mut [Edge], rig: &Rig) -> Vec<MovedKeyframe> {
        let mut moved: Vec<MovedKeyframe> = Vec::new();
        let mut newest = None;
        for ((keyframe, before), after) in self.keyframes.iter().zip(&self.before).zip(&self.graph.poses) {
            let before = Sim3::from(*before);
            newest = Some((before, *after));
            if !map.is_culled(*keyframe) && *after != before {
                move_keyframe(map, *keyframe, &before, after, &mut moved);
            }
        }
        let root = self.keyframes.first().map(|k| map.keyframes[*k].root);
        if let Some((before, after)) = newest.filter(|(before, after)| before != after) {
            for keyframe in self.known..map.keyframes.len() {
                if Some(map.keyframes[keyframe].root) == root && !map.is_culled(keyframe) {
                    move_keyframe(map, keyframe, &before, &after, &mut moved);
                }
            }
        }
        // Each moved once: by itself, or with its parent.
        moved.sort_unstable_by_key(|m| m.keyframe);
        for edge in edges {
            let growth = |k: usize| moved.binary_search_by_key(&k, |m| m.keyframe).map_or(1.0, |i| moved[i].growth);
            edge.a_from_b.translation *= growth(edge.a);
            edge.a_from_b.scale *= growth(edge.a) / growth(edge.b);
        }
        map.corrections += 1;
        self.fuse(map, rig);
        moved
    }

    /// Joins the place's landmarks with those of the keyframe, of its neighbours, and of the newest ones, which have seen it since.
    fn fuse(&self, map: &mut Map, rig: &Rig) {
        let keyframe = self.found.keyframe;
        let connected = map.covisible(keyframe).into_iter().filter(|(_, shared)| *shared >= CONNECTED_SHARED);
        let mut around: Vec<usize> = connected.map(|(k, _)| k).take(FUSED_NEIGHBOURS).collect();
        let since = (self.known..map.keyframes.len()).rev().take(FUSED_NEIGHBOURS);
        let lives = |k: &usize| !map.is_culled(*k) && map.connects(*k, keyframe);
        let since: Vec<usize> = since.filter(|k| lives(k) && !around.contains(k)).collect();
        around.extend(since);
        take_over(map, &self.found, self.known, &rig.config);
        for keyframe in std::iter::once(keyframe).chain(around) {
            fuse(map, keyframe, &self.found.landmarks, rig);
        }
    }
}

/// Moves a keyframe, with what hangs on it, as one that was at `before` has moved to `after`.
fn move_keyframe(map: &mut Map, keyframe: usize, before: &Sim3, after: &Sim3, moved: &mut Vec<MovedKeyframe>) {
    let pose = Sim3::from(map.keyframes[keyframe].camera_from_world) * before.inverse() * *after;
    let growth = 1.0 / pose.scale;
    let first = moved.len();
    moved.extend(map.with_carried(keyframe).map(|keyframe| MovedKeyframe { keyframe, growth }));
    moved[first..].iter().for_each(|m| map.keyframes[m.keyframe].unit *= growth);
    map.set_pose(keyframe, pose.to_rigid());
}

/// The edge of a recognised place.
pub fn loop_edge(map: &Map, found: &Recognised) -> Edge {
    let keyframe_from_place = found.corrected * Sim3::from(map.keyframes[found.place].camera_from_world).inverse();
    let depth = depth_around(map, found.keyframe);
    Edge { huber: Some(HUBER_SIGMAS), ..edge(found.keyframe, found.place, keyframe_from_place, found.matches.len(), depth) }
}

/// Median depth of what a keyframe sees, metres.
fn depth_around(map: &Map, keyframe: usize) -> f64 {
    map.keyframes[keyframe].features.median_depth().or_else(|| map.median_depth(keyframe)).unwrap_or(1.0)
}

fn edge(a: usize, b: usize, a_from_b: Sim3, shared: usize, depth: f64) -> Edge {
    let certainty = (shared as f64 / STRONG_SHARED as f64).sqrt();
    let (t, r) = (certainty / (SIGMA_TRANSLATION * depth), certainty / SIGMA_ROTATION_RAD);
    let weights = Vector7::from_column_slice(&[t, t, t, r, r, r, certainty / SIGMA_SCALE]);
    Edge { a, b, a_from_b, weights, huber: None }
}

/// The place's landmarks take over what the keyframe's features showed.
fn take_over(map: &mut Map, found: &Recognised, known: usize, config: &TrackingConfig) {
    for (landmark, feature) in &found.matches {
        // Another one may have its place by now.
        if map.landmarks[*landmark].first_keyframe >= known {
            continue;
        }
        let Some(landmark) = map.resolve(*landmark) else { continue };
        match map.keyframes[found.keyframe].landmarks[*feature] {
            Some(own) => map.merge(own, landmark),
            None => map.add_observation(landmark, Observation { keyframe: found.keyframe, feature: *feature }),
        }
        map.refresh_descriptor(landmark);
        map.refresh_geometry(landmark, config);
    }
}
