//! Loop closing: detection of a revisited place, and correction of the map by a pose graph.

mod correction;
mod detection;
#[cfg(test)]
pub mod tests;

use std::collections::BTreeSet;

use crate::geometry::Se3;
use crate::tracking::map::Map;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose_graph::Edge;
use correction::loop_edge;
pub use correction::{Correction, MovedKeyframe};
use detection::{Plausibility, Search, knows_scale};

/// Least keyframes between two closed loops.
const REST: usize = 5;
/// Loops that later corrections keep to, the newest; their keyframes are not culled.
const MOST_EDGES: usize = 100;
/// Where places repeat, a loop may correct less than this share of their distance: more may lead to the next that looks alike.
const REPEAT_SHARE: f64 = 0.3;

/// A loop that was closed, or the place at which two submaps joined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosedLoop {
    /// The keyframe that shows the place, by its id.
    pub keyframe: usize,
    /// The keyframe that showed it before.
    pub place: usize,
    /// Their relative pose as the loop has it, metres.
    pub keyframe_from_place: Se3,
}

/// Closes loops, and remembers them: later corrections keep to earlier ones.
#[derive(Clone, Debug)]
pub struct LoopCloser {
    /// The keyframe of the last loop.
    last: Option<usize>,
    /// How near to each other places were seen that look alike and cannot be the same.
    repeat_metres: f64,
    /// Loops that later corrections do not keep to any more.
    settled: Vec<ClosedLoop>,
    /// Factors of the other loops, and the keyframes at their ends.
    edges: Vec<Edge>,
    ends: BTreeSet<usize>,
}

impl Default for LoopCloser {
    fn default() -> Self {
        Self { last: None, repeat_metres: f64::INFINITY, settled: Vec::new(), edges: Vec::new(), ends: BTreeSet::new() }
    }
}

impl LoopCloser {
    /// The correction that follows if `keyframe`, one of the newest, shows a place left long ago, or one of another submap; it is still to
    /// be solved and taken into the map.
    pub fn recognise(&mut self, map: &mut Map, keyframe: usize, rig: &Rig) -> Option<Correction> {
        let rests = self.last.is_some_and(|last| keyframe < last + REST);
        if rests && map.is_connected() {
            return None;
        }
        let search = Search { map, rig, scale_is_free: !knows_scale(map) };
        let places = search.candidates(keyframe, self.repeat_metres.is_finite()).into_iter();
        let mut recognised = None;
        for found in places.filter_map(|place| search.recognise(keyframe, place)) {
            let in_one_submap = map.connects(keyframe, found.place);
            let shift_metres = search.shift_metres(&found);
            let plausibility = search.plausibility(&found);
            if plausibility == Plausibility::Repetition {
                self.repeat_metres = self.repeat_metres.min(shift_metres);
            }
            if plausibility != Plausibility::Drift {
                continue;
            }
            if in_one_submap && (rests || shift_metres > REPEAT_SHARE * self.repeat_metres) {
                tracing::debug!(keyframe, place = found.place, shift_metres, "a place that may be another one like it");
            } else {
                recognised = Some(found);
                break;
            }
        }
        let recognised = recognised?;
        let scale_is_free = search.scale_is_free;
        self.last = Some(keyframe);
        self.edges.push(loop_edge(map, &recognised));
        if self.edges.len() > MOST_EDGES {
            // What it joined, common landmarks hold together.
            self.settled.push(closed_loop(&self.edges.remove(0)));
        }
        self.ends = self.edges.iter().flat_map(|e| [e.a, e.b]).collect();
        let in_one_submap = map.connects(keyframe, recognised.place);
        let kind = if in_one_submap { "loop closed" } else { "submaps joined" };
        tracing::info!(keyframe, place = recognised.place, landmarks = recognised.matches.len(), "{kind}");
        Some(match in_one_submap {
            true => Correction::of_loop(map, recognised, &self.edges, scale_is_free),
            false => Correction::of_submaps(map, recognised),
        })
    }

    /// Takes a solved correction into the map; returns the keyframes that may have moved, in ascending order.
    pub fn apply(&mut self, correction: &Correction, map: &mut Map, rig: &Rig) -> Vec<MovedKeyframe> {
        correction.apply(map, &mut self.edges, rig)
    }

    /// All loops, in the order in which they were closed.
    pub fn loops(&self) -> Vec<ClosedLoop> {
        self.settled.iter().copied().chain(self.edges.iter().map(closed_loop)).collect()
    }

    /// Whether a loop begins or ends at a keyframe.
    pub fn holds(&self, keyframe: usize) -> bool {
        self.ends.contains(&keyframe)
    }
}

fn closed_loop(edge: &Edge) -> ClosedLoop {
    ClosedLoop { keyframe: edge.a, place: edge.b, keyframe_from_place: edge.a_from_b.to_rigid() }
}
