//! The tracking thread: tracks frames and sends keyframes to the mapper.

use std::collections::BTreeMap;

use crossbeam::channel::{Receiver, Sender, TrySendError};

use super::progress::{FrameImage, KeyframePoses, TrackingProgress, guarded};
use super::read_thread::QueuedFrame;
use super::{PipelineError, Progress};
use crate::geometry::{Se3, StampedPose, Trajectory};
use crate::mapping::{DepthSource, Keyframe, KeyframeId, MapperMessage, PoseUpdate, RightImage};
use crate::recording::Recording;
use crate::run_folder::FrameRecord;
use crate::sequence::{Frame, Rectifier, Sensor};
use crate::tracking::{DepthBias, KeyframePose, KeyframeUpdate, NewKeyframe, TrackedFrame, Tracker, TrackingState};

/// Result of the tracking thread, also when it ended early.
#[derive(Debug, Default)]
pub(super) struct TrackSummary {
    /// `(frame index, pose)` of every tracked frame, finally corrected.
    pub trajectory: Vec<(usize, StampedPose)>,
    pub keyframes: Vec<KeyframePose>,
    /// Image-only keyframes.
    pub images: Vec<KeyframePose>,
    pub frames: Vec<FrameRecord>,
    pub loops: Vec<[KeyframeId; 2]>,
    /// Real time: keyframes that the mapper never received.
    pub deferred: usize,
    pub depth_bias: Option<DepthBias>,
    pub pixel_sigma: Option<f64>,
    pub error: Option<PipelineError>,
}

/// The channel to the mapper, with its overflow policy.
pub(super) struct KeyframeSender<'a> {
    sender: &'a Sender<MapperMessage>,
    real_time: bool,
    /// Real time: the newest keyframe that found the channel full.
    waiting: Option<Box<Keyframe>>,
    /// Real time: poses that found the channel full, what was sent of each keyframe in one update.
    waiting_poses: BTreeMap<KeyframeId, PoseUpdate>,
    deferred: usize,
}

impl<'a> KeyframeSender<'a> {
    pub fn new(sender: &'a Sender<MapperMessage>, real_time: bool) -> Self {
        Self { sender, real_time, waiting: None, waiting_poses: BTreeMap::new(), deferred: 0 }
    }

    /// Sends a message; `false` if the mapper has closed the channel. In real time it waits in its turn while the channel is full: a keyframe
    /// replaces one that waits, and poses those of the same keyframes. An image-only one is left out.
    pub fn send(&mut self, message: MapperMessage) -> bool {
        if !self.real_time {
            return self.sender.send(message).is_ok();
        }
        match message {
            MapperMessage::PoseUpdate(updates) => self.add_poses(updates),
            // One image more or less hardly counts.
            MapperMessage::Keyframe(keyframe) if keyframe.image_only => {
                let sent = self.waiting.is_none().then(|| self.sender.try_send(MapperMessage::Keyframe(keyframe)));
                return !matches!(sent, Some(Err(TrySendError::Disconnected(_))));
            }
            MapperMessage::Keyframe(keyframe) => self.deferred += usize::from(self.waiting.replace(keyframe).is_some()),
            waits @ (MapperMessage::Points(_) | MapperMessage::Map(_) | MapperMessage::Remove(_)) => {
                return self.sender.send(waits).is_ok();
            }
        }
        self.retry()
    }

    /// Of each keyframe the newest pose waits, and the product of the scales. A keyframe that waits itself takes its own.
    fn add_poses(&mut self, updates: Vec<PoseUpdate>) {
        for update in updates {
            let scale = self.waiting_poses.get(&update.keyframe).map_or(1.0, |earlier| earlier.scale);
            self.waiting_poses.insert(update.keyframe, PoseUpdate { scale: scale * update.scale, ..update });
        }
        if let Some(keyframe) = &mut self.waiting
            && let Some(update) = self.waiting_poses.remove(&keyframe.id)
        {
            keyframe.update_pose(&update);
        }
    }

    /// Sends what waits, as far as there is room; `false` if the mapper has closed the channel.
    pub fn retry(&mut self) -> bool {
        if !self.waiting_poses.is_empty() {
            let poses = self.waiting_poses.values().copied().collect();
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

    /// Sends all that waits, the final poses, and the keyframes of submaps that never joined; returns the number of keyframes that the mapper
    /// never received. No newer keyframe replaces the one that waits.
    pub fn finish(mut self, last: Vec<PoseUpdate>, unjoined: Vec<KeyframeId>) -> usize {
        self.add_poses(last);
        if !self.waiting_poses.is_empty() {
            let _ = self.sender.send(MapperMessage::PoseUpdate(self.waiting_poses.into_values().collect()));
        }
        if let Some(keyframe) = self.waiting {
            let _ = self.sender.send(MapperMessage::Keyframe(keyframe));
        }
        if !unjoined.is_empty() {
            let _ = self.sender.send(MapperMessage::Remove(unjoined));
        }
        self.deferred
    }
}

/// Input of the tracking thread.
#[derive(Clone, Copy)]
pub(super) struct TrackThread<'a> {
    pub recording: &'a Recording,
    pub frames: &'a Receiver<QueuedFrame>,
    pub mapper: &'a Sender<MapperMessage>,
    pub progress: &'a Progress,
}

impl TrackThread<'_> {
    /// Tracks until the frames end, an error occurs, or the mapper closes the channel.
    pub fn track(&self) -> TrackSummary {
        let (sequence, config) = (self.recording.sequence(), self.recording.config());
        let mut summary = TrackSummary::default();
        let mut tracker = match Tracker::new(sequence.camera, sequence.sensor, &config.tracking) {
            Ok(tracker) => tracker.real_time(config.replay.real_time),
            Err(error) => return TrackSummary { error: Some(error.into()), ..summary },
        };
        let rectifier = Rectifier::new(&sequence.camera, config.map_scale);
        let mut whole = true;
        let mut shown = Shown { progress: self.progress, world_from_camera: None, moved: false };
        let mut keyframes = KeyframeSender::new(self.mapper, config.replay.real_time);
        for QueuedFrame { frame, extracted } in self.frames {
            let Some(extracted) = extracted else { continue };
            let may_be_keyframe = !config.replay.is_held_out(frame.index);
            let tracked = match guarded("tracking", || Ok(tracker.track_extracted(&extracted?, may_be_keyframe)?)) {
                Ok(tracked) => tracked,
                Err(error) => {
                    summary.error = Some(error);
                    whole = false;
                    break;
                }
            };
            let lost = tracked.state == TrackingState::Lost;
            summary.frames.push(FrameRecord { frame: frame.index, lost, times: tracked.times });
            shown.frame(&frame, &tracked, &tracker);
            if !keyframes.retry() || !self.send(&mut keyframes, &rectifier, &frame, tracked) {
                whole = false;
                break;
            }
        }
        // The adjustment in flight.
        let adjusted =
            guarded("tracking", || Ok(if whole { tracker.finish()? } else { tracker.break_off()? })).unwrap_or_else(|error| {
                summary.error.get_or_insert(error);
                Vec::new()
            });
        summary.trajectory = tracker.trajectory();
        summary.keyframes = tracker.keyframes();
        summary.images = tracker.image_only_keyframes();
        summary.depth_bias = tracker.depth_bias();
        summary.pixel_sigma = Some(tracker.pixel_sigma());
        summary.loops = loops(&tracker);
        self.progress.poses().put(poses(&tracker));
        let unjoined = tracker.unjoined_keyframes();
        if !unjoined.is_empty() {
            tracing::warn!(
                keyframes = unjoined.len(),
                "the camera was lost and began a submap whose place in the map was never recognised: its frames count as lost"
            );
        }
        let scales: BTreeMap<KeyframeId, f64> = adjusted.iter().map(|update| (update.id, update.scale)).collect();
        let last = |k: &KeyframePose| PoseUpdate {
            scale: scales.get(&k.frame_index).copied().unwrap_or(1.0),
            ..PoseUpdate::rigid(k.frame_index, k.world_from_camera)
        };
        summary.deferred = keyframes.finish(summary.keyframes.iter().chain(&summary.images).map(last).collect(), unjoined);
        summary
    }

    /// Sends a frame's pose updates and keyframe; `false` if the mapper has closed the channel.
    fn send(&self, keyframes: &mut KeyframeSender<'_>, rectifier: &Rectifier, frame: &Frame, tracked: TrackedFrame) -> bool {
        let updates: Vec<PoseUpdate> = tracked.updates.into_iter().map(pose_update).collect();
        if !updates.is_empty() && !keyframes.send(MapperMessage::PoseUpdate(updates)) {
            return false;
        }
        let Some(NewKeyframe { id, world_from_camera, seen, covisible, image_only }) = tracked.keyframe else { return true };
        let mut image = rectifier.rectify(frame);
        let mut depth_source = DepthSource::Sensor;
        if image.depth.is_none() && !seen.is_empty() {
            image.depth = Some(rectifier.sparse_depth(&seen));
            depth_source = DepthSource::Landmarks { right: right_image(rectifier, self.recording.sequence().sensor, frame) };
        }
        let covisible = covisible.into_iter().map(|(id, _)| id).collect();
        let keyframe = Keyframe { id, world_from_camera, image, depth_source, covisible, exposure: None, image_only };
        keyframes.send(MapperMessage::Keyframe(Box::new(keyframe)))
    }
}

/// What the thread shows of its progress.
struct Shown<'a> {
    progress: &'a Progress,
    /// Of the last frame that has a pose.
    world_from_camera: Option<Se3>,
    /// Whether keyframes came or moved since they were shown.
    moved: bool,
}

impl Shown<'_> {
    fn frame(&mut self, frame: &Frame, tracked: &TrackedFrame, tracker: &Tracker) {
        self.world_from_camera = tracked.world_from_camera.or(self.world_from_camera);
        self.moved |= tracked.keyframe.is_some() || !tracked.updates.is_empty();
        self.progress.tracking().put(TrackingProgress {
            frames_done: frame.index + 1,
            keyframes: tracker.keyframe_count(),
            lost: tracked.state == TrackingState::Lost,
            world_from_camera: self.world_from_camera,
            frame_ms: tracked.times.total_ms(),
        });
        show_image(self.progress, frame);
        if self.moved && self.progress.poses().is_wanted() {
            self.moved = false;
            self.progress.poses().put(poses(tracker));
        }
    }
}

/// Publishes a frame's image where it is wanted.
pub(super) fn show_image(progress: &Progress, frame: &Frame) {
    if progress.images().is_wanted() {
        progress.images().put(FrameImage { frame: frame.index, color: frame.color.clone() });
    }
}

fn poses(tracker: &Tracker) -> KeyframePoses {
    KeyframePoses { keyframes: tracker.keyframes(), loops: loops(tracker) }
}

/// Pairs of keyframes that closed loops join.
fn loops(tracker: &Tracker) -> Vec<[KeyframeId; 2]> {
    tracker.loops().iter().map(|closed| [closed.keyframe, closed.place]).collect()
}

fn pose_update(KeyframeUpdate { id, world_from_camera, scale }: KeyframeUpdate) -> PoseUpdate {
    PoseUpdate { keyframe: id, world_from_camera, scale }
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
    use crate::sequence::{DepthImage, RectifiedImage};

    fn keyframe(id: KeyframeId, image_only: bool) -> MapperMessage {
        let pinhole = Pinhole { fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5, width: 8, height: 8 };
        let depth = DepthImage { width: 8, height: 8, metres: vec![2.0; 64] };
        let image = RectifiedImage { pinhole, color: RgbImage::new(8, 8), depth: Some(depth), valid: None };
        let depth_source = DepthSource::Landmarks { right: None };
        let keyframe = Keyframe { depth_source, image_only, ..Keyframe::new(id, Se3::identity(), image) };
        MapperMessage::Keyframe(Box::new(keyframe))
    }

    fn moved(keyframe: KeyframeId, metres: f64, scale: f64) -> PoseUpdate {
        PoseUpdate { keyframe, world_from_camera: Se3::translation(metres, 0.0, 0.0), scale }
    }

    /// A loop moves each keyframe once: poses that find the channel full are sent later, the newest of each keyframe with all its scales.
    #[test]
    fn poses_that_find_the_channel_full_are_sent_later() {
        let (sender, messages) = bounded(1);
        let mut channel = KeyframeSender::new(&sender, true);
        assert!(channel.send(keyframe(0, false)));
        assert!(channel.send(MapperMessage::PoseUpdate(vec![moved(0, 1.0, 1.0), moved(1, 2.0, 1.5)])));
        assert!(channel.send(keyframe(2, false)) && channel.send(keyframe(3, false)) && channel.send(keyframe(4, true)));
        assert!(channel.send(MapperMessage::PoseUpdate(vec![moved(1, 3.0, 2.0), moved(3, 4.0, 1.25)])));
        assert!(matches!(messages.try_recv(), Ok(MapperMessage::Keyframe(k)) if k.id == 0));
        assert!(channel.retry());
        let Ok(MapperMessage::PoseUpdate(poses)) = messages.try_recv() else { panic!("poses come before the keyframe") };
        assert_eq!(poses, [moved(0, 1.0, 1.0), moved(1, 3.0, 3.0)]);
        assert!(channel.retry());
        let Ok(MapperMessage::Keyframe(sent)) = messages.try_recv() else { panic!("the keyframe that waited") };
        assert_eq!((sent.id, sent.world_from_camera), (3, moved(3, 4.0, 1.0).world_from_camera));
        assert!(sent.image.depth.unwrap().metres.iter().all(|metres| *metres == 2.5), "its depth is in the new scale");
        assert_eq!(channel.finish(Vec::new(), vec![5]), 1, "keyframe 2 was replaced");
        assert!(matches!(messages.try_recv(), Ok(MapperMessage::Remove(keyframes)) if keyframes == [5]));
        drop(messages);
        assert!(!KeyframeSender::new(&sender, true).send(keyframe(4, false)));
    }

    #[test]
    fn final_poses_carry_the_scales_that_wait() {
        let (sender, messages) = bounded(2);
        let mut channel = KeyframeSender::new(&sender, true);
        [0, 1, 2].into_iter().for_each(|id| assert!(channel.send(keyframe(id, false))));
        assert!(channel.send(MapperMessage::PoseUpdate(vec![moved(0, 1.0, 2.0), moved(2, 1.0, 2.0)])));
        messages.iter().take(2).for_each(drop);
        assert_eq!(channel.finish(vec![moved(0, 3.0, 1.5), moved(1, 2.0, 1.0), moved(2, 5.0, 1.5)], Vec::new()), 0);
        let Ok(MapperMessage::PoseUpdate(poses)) = messages.try_recv() else { panic!("poses come before the keyframe") };
        assert_eq!(poses, [moved(0, 3.0, 3.0), moved(1, 2.0, 1.0)]);
        let Ok(MapperMessage::Keyframe(last)) = messages.try_recv() else { panic!("the keyframe that waited") };
        assert_eq!(last.image.depth.unwrap().metres[0], 6.0);
    }
}
