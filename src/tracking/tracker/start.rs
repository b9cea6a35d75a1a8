//! How a submap begins: with one frame where there is depth, else with two.

use super::frames::Record;
use super::sightings::Sightings;
use super::{Lostness, Motion, Tracker};
use crate::geometry::Se3;
use crate::tracking::front_end::ExtractedFrame;
use crate::tracking::initialisation::mono::{self, FirstView, SecondView};
use crate::tracking::localisation::localise::LastFrame;
use crate::tracking::map::insertion;
use crate::tracking::map::sparse_map::Keyframe;
use crate::tracking::{StageTimes, TrackedFrame, TrackingState};

impl Tracker {
    /// Starts a submap with a frame that shows enough.
    pub(super) fn start(&mut self, frame: &ExtractedFrame, may: bool, times: StageTimes) -> TrackedFrame {
        let features = frame.features.clone();
        let points = (0..features.len()).filter(|i| features.point_in_camera(*i, &self.rig).is_some()).count();
        if !may || points < self.rig.config.min_initial_landmarks {
            return TrackedFrame::lost(times);
        }
        let camera_from_world = self.next_submap().inverse();
        let keyframe = Keyframe::new(frame.index, frame.timestamp_s, camera_from_world, features.clone());
        let keyframe = Keyframe { root: self.map.keyframes.len(), dense: frame.dense.clone(), ..keyframe };
        let id = insertion::insert_keyframe(&mut self.map, keyframe, &self.rig);
        let landmarks = self.map.keyframes[id].landmarks.clone();
        self.record(frame, id, Se3::identity(), Sightings::default());
        let started = self.started(LastFrame { features, camera_from_world, landmarks }, id, times);
        TrackedFrame { inliers: points, ..started }
    }

    /// Starts a submap with two frames that show one scene from two places.
    pub(super) fn start_without_depth(&mut self, frame: &ExtractedFrame, may: bool, times: StageTimes) -> TrackedFrame {
        if !may {
            return TrackedFrame::lost(times);
        }
        let features = frame.features.clone();
        let matches = self.first_view.as_mut().and_then(|first| first.follow(&features, &self.rig.pinhole));
        let (Some(first), Some(matches)) = (&self.first_view, matches) else {
            self.first_view = Some(FirstView::new(frame.index, frame.timestamp_s, features));
            return TrackedFrame::lost(times);
        };
        let second = SecondView { frame_index: frame.index, timestamp_s: frame.timestamp_s, features: &features };
        let Some(submap) = mono::first_map(first, &second, &matches, &self.rig) else { return TrackedFrame::lost(times) };
        let (first, second) = (self.map.keyframes.len(), self.map.keyframes.len() + 1);
        self.map.append(submap, &self.next_submap(), &self.rig.config);
        for reference in [first, second] {
            let Keyframe { frame_index, timestamp_s, .. } = self.map.keyframes[reference];
            let (camera_from_reference, sightings) = (Se3::identity(), Sightings::default());
            self.records.push(Record { frame_index, timestamp_s, reference, camera_from_reference, sightings });
        }
        let Keyframe { camera_from_world, ref landmarks, .. } = self.map.keyframes[second];
        let (inliers, landmarks) = (landmarks.iter().flatten().count(), landmarks.clone());
        let started = self.started(LastFrame { features, camera_from_world, landmarks }, second, times);
        TrackedFrame { inliers, ..started }
    }

    /// The frame that completes a start, which is keyframe `id`.
    fn started(&mut self, last: LastFrame, id: usize, times: StageTimes) -> TrackedFrame {
        let world_from_camera = Some(last.camera_from_world.inverse());
        self.note_mapped();
        self.first_view = None;
        self.motion = Motion { last: Some(last), velocity: None, reference: id };
        let frames_since_found = if self.lostness.is_lost { 0 } else { self.lostness.frames_since_found };
        self.lostness = Lostness { is_lost: false, frames_lost: 0, frames_since_found };
        let keyframe = Some(self.describe(id));
        TrackedFrame { state: TrackingState::Tracking, world_from_camera, inliers: 0, keyframe, updates: Vec::new(), times }
    }
}
