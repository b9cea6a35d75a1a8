//! Tracks frames and hands keyframes on to the mapper.

use crossbeam::channel::{Receiver, Sender, TrySendError};

use super::measurements::Listener;
use super::messages::{TrackingProgress, guarded};
use super::{FrameRecord, MapperMessage, PipelineError, Progress};
use crate::config::Config;
use crate::geometry::{StampedPose, Trajectory};
use crate::mapping::{DepthSource, Keyframe, RightImage};
use crate::sequence::{Frame, Rectifier, Sensor, Sequence};
use crate::tracking::{KeyframePose, NewKeyframe, TrackedFrame, Tracker, TrackingState};

/// What tracking came to, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct TrackSummary {
    /// `(frame index, pose)` of every tracked frame, finally corrected.
    pub trajectory: Vec<(usize, StampedPose)>,
    pub keyframes: Vec<KeyframePose>,
    pub frames: Vec<FrameRecord>,
    /// Paced replay: keyframes that the mapper never got.
    pub deferred: usize,
    pub error: Option<PipelineError>,
}

/// The way to the mapper, with its overflow policy.
pub(super) struct KeyframeSender<'a> {
    sender: &'a Sender<MapperMessage>,
    paced: bool,
    /// Paced: the newest keyframe that found the channel full.
    waiting: Option<MapperMessage>,
    deferred: usize,
}

impl<'a> KeyframeSender<'a> {
    pub fn new(sender: &'a Sender<MapperMessage>, paced: bool) -> Self {
        Self { sender, paced, waiting: None, deferred: 0 }
    }

    /// Says whether the mapper still listens.
    pub fn send(&mut self, message: MapperMessage) -> bool {
        if !self.paced {
            return self.sender.send(message).is_ok();
        }
        let is_keyframe = matches!(message, MapperMessage::Keyframe(_));
        match self.sender.try_send(message) {
            Ok(()) => true,
            // A pose update that finds no room is followed by a newer one.
            Err(TrySendError::Full(_)) if !is_keyframe => true,
            Err(TrySendError::Full(message)) => {
                self.deferred += usize::from(self.waiting.replace(message).is_some());
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        }
    }

    pub fn retry(&mut self) -> bool {
        match self.waiting.take() {
            Some(message) => self.send(message),
            None => true,
        }
    }

    /// Sends the last keyframe, which has no newer one to give way to; returns how many the mapper never got.
    pub fn finish(self) -> usize {
        if let Some(message) = self.waiting {
            let _ = self.sender.send(message);
        }
        self.deferred
    }
}

/// Tracks until the frames end, an error, or the mapper stops listening.
pub(super) fn track(
    sequence: &Sequence,
    config: &Config,
    frames: &Receiver<Frame>,
    mapper: &Sender<MapperMessage>,
    mut listener: Listener,
    progress: &Progress,
) -> TrackSummary {
    let mut summary = TrackSummary::default();
    let mut tracker = match Tracker::new(sequence.camera, sequence.sensor, &config.tracking) {
        Ok(tracker) => tracker.paced(config.replay.paced),
        Err(error) => return TrackSummary { error: Some(error.into()), ..summary },
    };
    let rectifier = Rectifier::new(&sequence.camera, config.map_scale);
    let mut sender = KeyframeSender::new(mapper, config.replay.paced);
    for frame in frames {
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
        let (frames_done, keyframes) = (frame.index + 1, tracker.keyframes().len());
        progress.tracking.force_push(TrackingProgress { frames_done, keyframes, lost });
        let keyframe = tracked.keyframe.as_ref().map(|k| k.id);
        if !sender.retry() || !hand_on(&mut sender, (&rectifier, sequence.sensor), &frame, tracked) {
            break;
        }
        if let Err(error) = tracker.measure(&listener.hear(keyframe)) {
            summary.error = Some(error.into());
            break;
        }
    }
    // What is still under way; its updates are part of the last word.
    if let Err(error) = guarded("tracking", || Ok(tracker.finish()?)) {
        summary.error.get_or_insert(error);
    }
    summary.deferred = sender.finish();
    summary.trajectory = tracker.trajectory();
    summary.keyframes = tracker.keyframes();
    let last_word = summary.keyframes.iter().map(|k| (k.id, k.world_from_camera)).collect();
    let _ = mapper.send(MapperMessage::PoseUpdate(last_word));
    summary
}

fn hand_on(
    sender: &mut KeyframeSender<'_>,
    (rectifier, sensor): (&Rectifier, Sensor),
    frame: &Frame,
    tracked: TrackedFrame,
) -> bool {
    if !tracked.updates.is_empty() && !sender.send(MapperMessage::PoseUpdate(tracked.updates)) {
        return false;
    }
    let Some(NewKeyframe { id, world_from_camera, seen, covisible }) = tracked.keyframe else { return true };
    let mut image = rectifier.rectify(frame);
    let mut depth_source = DepthSource::Sensor;
    if image.depth.is_none() && !seen.is_empty() {
        image.depth = Some(rectifier.sparse_depth(&seen));
        depth_source = DepthSource::Landmarks { right: right_image(rectifier, sensor, frame) };
    }
    let covisible = covisible.into_iter().map(|(id, _)| id).collect();
    let keyframe = Keyframe { id, world_from_camera, image, depth_source, covisible };
    sender.send(MapperMessage::Keyframe(Box::new(keyframe)))
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
