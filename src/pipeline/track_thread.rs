//! The tracking thread: tracks frames and sends keyframes to the mapper.

use std::collections::BTreeMap;

use crossbeam::channel::{Receiver, Sender, TrySendError};

use super::pose_feedback::PoseFeedbackReceiver;
use super::progress::{TrackingProgress, guarded};
use super::{PipelineError, Progress};
use crate::geometry::{Se3, StampedPose, Trajectory};
use crate::mapping::{DepthSource, Keyframe, KeyframeId, MapperMessage, RightImage};
use crate::recording::Recording;
use crate::run_folder::FrameRecord;
use crate::sequence::{Frame, Rectifier, Sensor};
use crate::tracking::{KeyframePose, NewKeyframe, TrackedFrame, Tracker, TrackingState};

/// Result of the tracking thread, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct TrackSummary {
    /// `(frame index, pose)` of every tracked frame, finally corrected.
    pub trajectory: Vec<(usize, StampedPose)>,
    pub keyframes: Vec<KeyframePose>,
    pub frames: Vec<FrameRecord>,
    /// Real time: keyframes that the mapper never received.
    pub deferred: usize,
    pub error: Option<PipelineError>,
}

/// The channel to the mapper, with its overflow policy.
pub(super) struct KeyframeSender<'a> {
    sender: &'a Sender<MapperMessage>,
    real_time: bool,
    /// Real time: the newest keyframe that found the channel full.
    waiting: Option<Box<Keyframe>>,
    /// Real time: the newest poses that found the channel full.
    waiting_poses: BTreeMap<KeyframeId, Se3>,
    deferred: usize,
}

impl<'a> KeyframeSender<'a> {
    pub fn new(sender: &'a Sender<MapperMessage>, real_time: bool) -> Self {
        Self { sender, real_time, waiting: None, waiting_poses: BTreeMap::new(), deferred: 0 }
    }

    /// Sends a message; `false` if the mapper has closed the channel. In real time it waits in its turn while the channel is full: a keyframe
    /// replaces one that waits, and poses those of the same keyframes.
    pub fn send(&mut self, message: MapperMessage) -> bool {
        if !self.real_time {
            return self.sender.send(message).is_ok();
        }
        match message {
            MapperMessage::PoseUpdate(poses) => self.waiting_poses.extend(poses),
            MapperMessage::Keyframe(keyframe) => self.deferred += usize::from(self.waiting.replace(keyframe).is_some()),
            points @ MapperMessage::Points(_) => return self.sender.send(points).is_ok(),
        }
        self.retry()
    }

    /// Sends what waits, as far as there is room; `false` if the mapper has closed the channel.
    pub fn retry(&mut self) -> bool {
        if let Some(keyframe) = &mut self.waiting
            && let Some(pose) = self.waiting_poses.remove(&keyframe.id)
        {
            keyframe.world_from_camera = pose;
        }
        if !self.waiting_poses.is_empty() {
            let poses = self.waiting_poses.iter().map(|(id, pose)| (*id, *pose)).collect();
            match self.sender.try_send(MapperMessage::PoseUpdate(poses)) {
                Ok(()) => self.waiting_poses.clear(),
                Err(TrySendError::Full(_)) => return true,
                Err(TrySendError::Disconnected(_)) => return false,
            }
        }
        let Some(keyframe) = self.waiting.take() else { return true };
        match self.sender.try_send(MapperMessage::Keyframe(keyframe)) {
            Err(TrySendError::Full(MapperMessage::Keyframe(keyframe))) => self.waiting = Some(keyframe),
            Err(TrySendError::Disconnected(_)) => return false,
            _ => {}
        }
        true
    }

    /// Sends the keyframe that waits, which no newer one replaces; returns the number of keyframes that the mapper never received. Poses that
    /// wait are part of the final pose update.
    pub fn finish(self) -> usize {
        if let Some(keyframe) = self.waiting {
            let _ = self.sender.send(MapperMessage::Keyframe(keyframe));
        }
        self.deferred
    }
}

/// Input of the tracking thread.
#[derive(Clone, Copy)]
pub(super) struct TrackThread<'a> {
    pub recording: &'a Recording,
    pub frames: &'a Receiver<Frame>,
    pub mapper: &'a Sender<MapperMessage>,
    pub progress: &'a Progress,
}

impl TrackThread<'_> {
    /// Tracks until the frames end, an error occurs, or the mapper closes the channel.
    pub fn track(&self, mut feedback: PoseFeedbackReceiver) -> TrackSummary {
        let (sequence, config) = (self.recording.sequence(), self.recording.config());
        let mut summary = TrackSummary::default();
        let mut tracker = match Tracker::new(sequence.camera, sequence.sensor, &config.tracking) {
            Ok(tracker) => tracker.real_time(config.replay.real_time),
            Err(error) => return TrackSummary { error: Some(error.into()), ..summary },
        };
        let rectifier = Rectifier::new(&sequence.camera, config.map_scale);
        let mut keyframes = KeyframeSender::new(self.mapper, config.replay.real_time);
        for frame in self.frames {
            let may_be_keyframe = !config.replay.is_held_out(frame.index);
            let tracked = match guarded("tracking", || Ok(tracker.track(&frame, may_be_keyframe)?)) {
                Ok(tracked) => tracked,
                Err(error) => {
                    summary.error = Some(error);
                    break;
                }
            };
            let lost = tracked.state == TrackingState::Lost;
            summary.frames.push(FrameRecord { frame: frame.index, lost, times: tracked.times });
            let progress = TrackingProgress { frames_done: frame.index + 1, keyframes: tracker.keyframes().len(), lost };
            self.progress.tracking.force_push(progress);
            let keyframe = tracked.keyframe.as_ref().map(|k| k.id);
            if !keyframes.retry() || !self.send(&mut keyframes, &rectifier, &frame, tracked) {
                break;
            }
            if let Err(error) = tracker.measure(&feedback.receive(keyframe)) {
                summary.error = Some(error.into());
                break;
            }
        }
        // The adjustment in flight; its updates are part of the final pose update.
        if let Err(error) = guarded("tracking", || Ok(tracker.finish()?)) {
            summary.error.get_or_insert(error);
        }
        summary.deferred = keyframes.finish();
        summary.trajectory = tracker.trajectory();
        summary.keyframes = tracker.keyframes();
        let final_poses = summary.keyframes.iter().map(|k| (k.id, k.world_from_camera)).collect();
        let _ = self.mapper.send(MapperMessage::PoseUpdate(final_poses));
        summary
    }

    /// Sends a frame's pose updates and keyframe; `false` if the mapper has closed the channel.
    fn send(&self, keyframes: &mut KeyframeSender<'_>, rectifier: &Rectifier, frame: &Frame, tracked: TrackedFrame) -> bool {
        if !tracked.updates.is_empty() && !keyframes.send(MapperMessage::PoseUpdate(tracked.updates)) {
            return false;
        }
        let Some(NewKeyframe { id, world_from_camera, seen, covisible }) = tracked.keyframe else { return true };
        let mut image = rectifier.rectify(frame);
        let mut depth_source = DepthSource::Sensor;
        if image.depth.is_none() && !seen.is_empty() {
            image.depth = Some(rectifier.sparse_depth(&seen));
            depth_source = DepthSource::Landmarks { right: right_image(rectifier, self.recording.sequence().sensor, frame) };
        }
        let covisible = covisible.into_iter().map(|(id, _)| id).collect();
        let keyframe = Keyframe { id, world_from_camera, image, depth_source, covisible };
        keyframes.send(MapperMessage::Keyframe(Box::new(keyframe)))
    }
}

/// The right image of a stereo frame, at the mapping resolution.
pub(super) fn right_image(rectifier: &Rectifier, sensor: Sensor, frame: &Frame) -> Option<RightImage> {
    match (sensor, &frame.right) {
        (Sensor::Stereo { baseline_metres }, Some(right)) => {
            Some(RightImage { gray: rectifier.rectify_right(right), baseline_metres })
        }
        _ => None,
    }
}

impl TrackSummary {
    /// The poses without their frame numbers.
    pub fn stamped(&self) -> Trajectory {
        Trajectory { poses: self.trajectory.iter().map(|(_, pose)| *pose).collect() }
    }
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::bounded;
    use image::RgbImage;

    use super::*;
    use crate::geometry::Pinhole;
    use crate::sequence::RectifiedImage;

    fn keyframe(id: KeyframeId) -> MapperMessage {
        let pinhole = Pinhole { fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5, width: 8, height: 8 };
        let image = RectifiedImage { pinhole, color: RgbImage::new(8, 8), depth: None, valid: None };
        let world_from_camera = Se3::identity();
        let keyframe = Keyframe { id, world_from_camera, image, depth_source: DepthSource::Sensor, covisible: Vec::new() };
        MapperMessage::Keyframe(Box::new(keyframe))
    }

    fn moved(metres: f64) -> Se3 {
        Se3::translation(metres, 0.0, 0.0)
    }

    /// A loop moves each keyframe once: poses that find the channel full are sent later, the newest of each keyframe.
    #[test]
    fn poses_that_find_the_channel_full_are_sent_later() {
        let (sender, messages) = bounded(1);
        let mut channel = KeyframeSender::new(&sender, true);
        assert!(channel.send(keyframe(0)));
        assert!(channel.send(MapperMessage::PoseUpdate(vec![(0, moved(1.0)), (1, moved(2.0))])));
        assert!(channel.send(keyframe(2)) && channel.send(keyframe(3)));
        assert!(channel.send(MapperMessage::PoseUpdate(vec![(1, moved(3.0)), (3, moved(4.0))])));
        assert!(matches!(messages.try_recv(), Ok(MapperMessage::Keyframe(k)) if k.id == 0));
        assert!(channel.retry());
        let Ok(MapperMessage::PoseUpdate(poses)) = messages.try_recv() else { panic!("poses come before the keyframe") };
        assert_eq!(poses, [(0, moved(1.0)), (1, moved(3.0))]);
        assert!(channel.retry());
        assert!(matches!(messages.try_recv(), Ok(MapperMessage::Keyframe(k)) if k.id == 3 && k.world_from_camera == moved(4.0)));
        assert_eq!(channel.finish(), 1, "keyframe 2 was replaced");
        drop(messages);
        assert!(!KeyframeSender::new(&sender, true).send(keyframe(4)));
    }
}
