//! How a map begins: with one frame where there is depth, else with two.

use std::sync::Arc;

use super::{Record, Tracker};
use crate::geometry::Se3;
use crate::sequence::Frame;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::initialisation::mono::{self, FirstView, SecondView};
use crate::tracking::localisation::localise::LastFrame;
use crate::tracking::map::insertion;
use crate::tracking::map::sparse_map::Keyframe;
use crate::tracking::{StageTimes, TrackedFrame, TrackingState};

impl Tracker {
    /// Starts the map with a frame that shows enough.
    pub(super) fn start(&mut self, frame: &Frame, features: Arc<FrameFeatures>, may: bool, times: StageTimes) -> TrackedFrame {
        let with_depth = features.features.iter().filter(|f| f.depth_metres.is_some()).count();
        if !may || with_depth < self.rig.config.min_initial_landmarks {
            return TrackedFrame::lost(times);
        }
        let keyframe = Keyframe {
            frame_index: frame.index,
            timestamp_s: frame.timestamp_s,
            camera_from_world: Se3::identity(),
            features: features.clone(),
            landmarks: Vec::new(),
        };
        let id = insertion::insert_keyframe(&mut self.map, keyframe, &self.rig);
        let landmarks = self.map.keyframes[id].landmarks.clone();
        self.motion.last = Some(LastFrame { features, camera_from_world: Se3::identity(), landmarks });
        self.record(frame, id, Se3::identity());
        TrackedFrame {
            state: TrackingState::Tracking,
            world_from_camera: Some(Se3::identity()),
            inliers: with_depth,
            keyframe: Some(self.describe(id)),
            updates: Vec::new(),
            times,
        }
    }

    /// Starts the map with two frames that show one scene from two places.
    pub(super) fn start_without_depth(
        &mut self,
        frame: &Frame,
        features: Arc<FrameFeatures>,
        may: bool,
        times: StageTimes,
    ) -> TrackedFrame {
        if !may {
            return TrackedFrame::lost(times);
        }
        let matches = self.first_view.as_mut().and_then(|first| first.follow(&features, &self.rig.pinhole));
        let (Some(first), Some(matches)) = (&self.first_view, matches) else {
            self.first_view = Some(FirstView::new(frame.index, frame.timestamp_s, features));
            return TrackedFrame::lost(times);
        };
        let second = SecondView { frame_index: frame.index, timestamp_s: frame.timestamp_s, features: &features };
        let Some(map) = mono::first_map(first, &second, &matches, &self.rig) else { return TrackedFrame::lost(times) };
        self.map = map;
        self.first_view = None;
        let keyframes = self.keyframes();
        let [first, second] = &keyframes[..] else { return TrackedFrame::lost(times) };
        for keyframe in [first, second] {
            let (frame_index, timestamp_s, reference) = (keyframe.frame_index, keyframe.timestamp_s, keyframe.id);
            self.records.push(Record { frame_index, timestamp_s, reference, camera_from_reference: Se3::identity() });
        }
        let (id, world_from_camera) = (second.id, second.world_from_camera);
        self.motion.reference = id;
        let landmarks = self.map.keyframes[id].landmarks.clone();
        let inliers = landmarks.iter().flatten().count();
        self.motion.last = Some(LastFrame { features, camera_from_world: world_from_camera.inverse(), landmarks });
        TrackedFrame {
            state: TrackingState::Tracking,
            world_from_camera: Some(world_from_camera),
            inliers,
            keyframe: Some(self.describe(id)),
            updates: Vec::new(),
            times,
        }
    }
}
