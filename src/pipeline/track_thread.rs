//! The tracking thread: tracks frames and sends keyframes to the mapper.

use crossbeam::channel::{Receiver, Sender, TrySendError};

use super::pose_feedback::PoseFeedbackReceiver;
use super::progress::{TrackingProgress, guarded};
use super::{PipelineError, Progress};
use crate::geometry::{StampedPose, Trajectory};
use crate::mapping::{DepthSource, Keyframe, MapperMessage, RightImage};
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
    waiting: Option<MapperMessage>,
    deferred: usize,
}

impl<'a> KeyframeSender<'a> {
    pub fn new(sender: &'a Sender<MapperMessage>, real_time: bool) -> Self {
        Self { sender, real_time, waiting: None, deferred: 0 }
    }

    /// Sends a message; `false` if the mapper has closed the channel.
    pub fn send(&mut self, message: MapperMessage) -> bool {
        if !self.real_time {
            return self.sender.send(message).is_ok();
        }
        let is_keyframe = matches!(message, MapperMessage::Keyframe(_));
        match self.sender.try_send(message) {
            Ok(()) => true,
            // A pose update that finds the channel full is followed by a newer one.
            Err(TrySendError::Full(_)) if !is_keyframe => true,
            Err(TrySendError::Full(message)) => {
                self.deferred += usize::from(self.waiting.replace(message).is_some());
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        }
    }

    /// Sends the keyframe that waits, if any; `false` if the mapper has closed the channel.
    pub fn retry(&mut self) -> bool {
        match self.waiting.take() {
            Some(message) => self.send(message),
            None => true,
        }
    }

    /// Sends the keyframe that waits, which no newer one replaces; returns the number of keyframes that the mapper never received.
    pub fn finish(self) -> usize {
        if let Some(message) = self.waiting {
            let _ = self.sender.send(message);
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

fn right_image(rectifier: &Rectifier, sensor: Sensor, frame: &Frame) -> Option<RightImage> {
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
