//! Submaps: a camera that stays lost begins a new one, which joins the older ones when a place of theirs is recognised (Campos et al.,
//! *ORB-SLAM3*, 2021: the *Atlas*).
//!
//! All submaps share one [`Map`](crate::tracking::map::sparse_map::Map), and loop closing joins them. Until then a new one lies where no camera of
//! the others sees it.

use std::collections::BTreeMap;

use super::Tracker;
use crate::geometry::Se3;
use crate::sequence::Sensor;
use crate::tracking::front_end::ExtractedFrame;
use crate::tracking::map::sparse_map::Keyframe;
use crate::tracking::{StageTimes, TrackedFrame, TrackingError};

/// Seconds without a pose after which a new submap begins.
const LOST_AFTER_S: f64 = 1.0;
/// Distance of a new submap from the others, in median depths of the scene: a room is then a few pixels large.
const APART_DEPTHS: f64 = 100.0;

impl Tracker {
    /// How many frames are missing between the last one and this, going by the interval before.
    pub(super) fn missing_before(&mut self, frame: &ExtractedFrame) -> usize {
        let interval_s = self.arrival.map(|(last_s, _)| (frame.timestamp_s - last_s).abs());
        let usual_s = self.arrival.and_then(|(_, usual_s)| usual_s).filter(|usual_s| *usual_s > 0.0);
        self.arrival = Some((frame.timestamp_s, interval_s));
        let intervals = interval_s.zip(usual_s).map_or(1.0, |(interval_s, usual_s)| (interval_s / usual_s).round());
        (intervals as usize).saturating_sub(1)
    }

    /// Time between the last two frames, seconds.
    pub(super) fn interval_s(&self) -> Option<f64> {
        self.arrival.and_then(|(_, interval_s)| interval_s)
    }

    /// camera_from_last_camera of this frame, as the last two had it; none where they do not say.
    pub(super) fn expected_motion(&self) -> Se3 {
        self.motion.velocity.as_ref().map_or_else(Se3::identity, |velocity| velocity.motion_in(self.interval_s()))
    }

    /// A frame without a pose: after a while it begins a new submap.
    pub(super) fn lose(
        &mut self,
        frame: &ExtractedFrame,
        may_be_keyframe: bool,
        mut times: StageTimes,
    ) -> Result<TrackedFrame, TrackingError> {
        self.lostness.frames_lost += 1;
        self.lostness.is_lost = true;
        self.motion.velocity = None;
        let since_s = self.records.last().map_or(0.0, |last| (frame.timestamp_s - last.timestamp_s).abs());
        if since_s < LOST_AFTER_S || !may_be_keyframe {
            return Ok(TrackedFrame::lost(times));
        }
        self.finish_adjustment_before_keyframe(&mut times)?;
        Ok(match self.sensor {
            Sensor::Mono => self.start_without_depth(frame, may_be_keyframe, times),
            _ => self.start(frame, may_be_keyframe, times),
        })
    }

    /// world_from_submap of the next submap: the first is the world.
    pub(super) fn next_submap(&self) -> Se3 {
        let map = &self.map;
        let furthest = map.keyframes.iter().map(|k| k.centre().x).reduce(f64::max);
        let apart = |furthest| furthest + APART_DEPTHS * map.median_depth(self.motion.reference).unwrap_or(1.0);
        Se3::translation(furthest.map_or(0.0, apart), 0.0, 0.0)
    }

    /// Keyframes of submaps that did not join the largest one, image-only ones included, ascending.
    pub fn unjoined_keyframes(&self) -> Vec<usize> {
        let largest = self.largest_submap();
        let apart = |k: &Keyframe| k.root != largest;
        let mut keyframes: Vec<usize> = self.map.keyframes.iter().filter(|k| apart(k)).map(|k| k.frame_index).collect();
        keyframes.extend(self.image_only_where(apart).iter().map(|k| k.frame_index));
        keyframes.sort_unstable();
        keyframes
    }

    /// The first keyframe of the submap in which most frames have their poses; of equals the oldest.
    pub(in crate::tracking) fn largest_submap(&self) -> usize {
        let mut frames: BTreeMap<usize, usize> = BTreeMap::new();
        for record in &self.records {
            *frames.entry(self.map.keyframes[record.reference].root).or_default() += 1;
        }
        frames.into_iter().rev().max_by_key(|(_, frames)| *frames).map_or(0, |(root, _)| root)
    }
}
