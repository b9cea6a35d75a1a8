//! Loop closing: detection of a revisited place, and correction of the map by a pose graph.

mod correction;
mod detection;
#[cfg(test)]
pub mod tests;

use crate::geometry::Se3;
use crate::tracking::map::Map;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose_graph::Edge;
pub use correction::MovedKeyframe;
use correction::correct;
use detection::{Search, knows_scale};

/// Least keyframes between two closed loops.
const REST: usize = 5;

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
#[derive(Clone, Debug, Default)]
pub struct LoopCloser {
    /// The keyframe of the last loop.
    last: Option<usize>,
    /// Factors of all loops.
    edges: Vec<Edge>,
}

impl LoopCloser {
    /// Closes a loop if `keyframe`, one of the newest, shows a place left long ago, or joins its submap with another that shows the place.
    /// Returns the keyframes that moved, in ascending order; none if no place was recognised.
    pub fn close(&mut self, map: &mut Map, keyframe: usize, rig: &Rig) -> Vec<MovedKeyframe> {
        let rests = self.last.is_some_and(|last| keyframe < last + REST);
        if rests && map.is_connected() {
            return Vec::new();
        }
        let search = Search { map, rig, scale_is_free: !knows_scale(map) };
        let places = search.candidates(keyframe).into_iter().filter(|place| !rests || !map.connects(keyframe, *place));
        let recognised = places.into_iter().find_map(|place| search.recognise(keyframe, place));
        let Some(recognised) = recognised else { return Vec::new() };
        let scale_is_free = search.scale_is_free;
        self.last = Some(keyframe);
        let kind = if map.connects(keyframe, recognised.place) { "loop closed" } else { "submaps joined" };
        tracing::info!(keyframe, place = recognised.place, landmarks = recognised.matches.len(), "{kind}");
        correct(map, &recognised, &mut self.edges, scale_is_free, rig)
    }

    /// All loops, in the order in which they were closed.
    pub fn loops(&self) -> Vec<ClosedLoop> {
        let of = |e: &Edge| ClosedLoop { keyframe: e.a, place: e.b, keyframe_from_place: e.a_from_b.to_rigid() };
        self.edges.iter().map(of).collect()
    }

    /// Whether a loop begins or ends at a keyframe.
    pub fn holds(&self, keyframe: usize) -> bool {
        self.edges.iter().any(|e| e.a == keyframe || e.b == keyframe)
    }
}
