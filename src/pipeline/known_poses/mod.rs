//! Replaces tracking where the recording provides poses.
//!
//! Photos become keyframes all, frames of a moving camera by the tracker's thresholds, and image-only ones between them; held-out ones never.
//! Frames without a pose count as lost. Where the recording has no depth, points begin the map: its own, or triangulated ones, which the
//! plane sweep then uses as landmarks. A map of others begins it where one is given. The world's unit is that of the poses. A finished run that
//! is refined has keyframes of its own.

mod refined;
mod scene;

use std::time::Instant;

pub(super) use scene::Scene;

use refined::Refined;

use super::progress::{KeyframePoses, TrackingProgress, guarded};
use super::read_thread::QueuedFrame;
use super::track_thread::{KeyframeSender, TrackSummary, TrackThread, right_image, show_image};
use crate::geometry::{Se3, StampedPose};
use crate::mapping::{DepthSource, Keyframe, MapperMessage};
use crate::recording::Recording;
use crate::run_folder::FrameRecord;
use crate::sequence::{Frame, Rectifiers, Sensor};
use crate::tracking::{KeyframePose, StageTimes, is_image_due};

/// Neighbours that a keyframe names.
const COVISIBLE: usize = 10;

/// A keyframe so far.
struct Known {
    pose: KeyframePose,
    /// Median distance of what it sees, in the world's unit.
    distance: f64,
}

struct Follower<'a> {
    recording: &'a Recording,
    scene: &'a Scene<'a>,
    rectifiers: Rectifiers,
    keyframes: Vec<Known>,
    images: Vec<KeyframePose>,
}

impl Follower<'_> {
    /// How far apart two views are: 1 where a keyframe is due, by distance or by angle.
    fn apart(&self, a: &Known, world_from_camera: &Se3) -> f64 {
        let a_from_camera = a.pose.world_from_camera.inverse() * world_from_camera;
        let moved =
            a_from_camera.translation.vector.norm() / (self.recording.config().tracking.keyframe_translation * a.distance);
        moved.max(a_from_camera.rotation.angle() / self.recording.config().tracking.keyframe_rotation_rad)
    }

    fn pose(&self, frame: &Frame) -> Option<Se3> {
        let known = || self.recording.known_pose(frame.timestamp_s);
        let of_run = |refined: &Refined| Some(refined.keyframes.get(&frame.index)?.world_from_camera);
        self.scene.refined().map_or_else(known, of_run)
    }

    /// Whether the keyframe that a frame becomes is image-only; `None` if it becomes none.
    fn image_only(&self, frame: &Frame, world_from_camera: &Se3) -> Option<bool> {
        if let Some(refined) = self.scene.refined() {
            return refined.keyframes.get(&frame.index).map(|keyframe| keyframe.image_only);
        }
        if self.recording.config().replay.is_held_out(frame.index) {
            return None;
        }
        let photos = self.recording.sequence().layout.is_photos();
        let Some(last) = self.keyframes.last().filter(|_| !photos) else { return Some(false) };
        if self.apart(last, world_from_camera) >= 1.0 {
            return Some(false);
        }
        let newest = self.images.last().filter(|image| image.frame_index > last.pose.frame_index).unwrap_or(&last.pose);
        let motion = self.apart(&Known { pose: *newest, distance: last.distance }, world_from_camera);
        let since_s = frame.timestamp_s - newest.timestamp_s;
        is_image_due(since_s, motion, &self.recording.config().tracking).then_some(true)
    }

    /// The nearest keyframes, nearest first.
    fn covisible(&self, world_from_camera: &Se3) -> Vec<usize> {
        let mut nearest: Vec<(f64, usize)> =
            self.keyframes.iter().map(|known| (self.apart(known, world_from_camera), known.pose.frame_index)).collect();
        nearest.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        nearest.into_iter().take(COVISIBLE).map(|(_, id)| id).collect()
    }

    fn poses(&self) -> KeyframePoses {
        KeyframePoses { keyframes: self.keyframes.iter().map(|known| known.pose).collect(), loops: Vec::new() }
    }

    fn make_keyframe(&mut self, frame: &Frame, world_from_camera: Se3, image_only: bool) -> Keyframe {
        let sequence = self.recording.sequence();
        let rectifier = self.rectifiers.of(sequence.camera_of(frame.index));
        let mut image = rectifier.rectify(frame);
        let landmarks = if image_only { Vec::new() } else { self.scene.landmarks(frame.index) };
        let mut depth_source = DepthSource::Sensor;
        if image.depth.is_none() && !landmarks.is_empty() {
            image.depth = Some(rectifier.sparse_depth(&landmarks));
            depth_source = DepthSource::Landmarks { right: right_image(&rectifier, sequence.sensor, frame) };
        }
        let covisible = self.covisible(&world_from_camera);
        let pose = KeyframePose { frame_index: frame.index, timestamp_s: frame.timestamp_s, world_from_camera };
        let distance = image.median_depth_metres().unwrap_or_else(|| self.scene.distance());
        if image_only {
            self.images.push(pose);
        } else {
            self.keyframes.push(Known { pose, distance });
        }
        let refined = self.scene.refined().and_then(|refined| refined.keyframes.get(&frame.index));
        if let Some(valid) = refined.and_then(|keyframe| keyframe.valid.as_ref()) {
            image.restrict(valid);
        }
        let exposure = refined.map(|keyframe| keyframe.exposure);
        Keyframe { id: frame.index, world_from_camera, image, depth_source, covisible, exposure, image_only }
    }
}

/// Sends keyframes at their known poses until the frames end, or the mapper closes the channel.
pub(super) fn follow(thread: &TrackThread<'_>, scene: &Scene<'_>) -> TrackSummary {
    let TrackThread { recording, frames, mapper, progress } = *thread;
    let (sequence, config) = (recording.sequence(), recording.config());
    let mut summary = TrackSummary::default();
    let mut sender = KeyframeSender::new(mapper, config.replay.real_time);
    let mut follower =
        Follower { recording, scene, rectifiers: Rectifiers::new(config.map_scale), keyframes: Vec::new(), images: Vec::new() };
    let first = match scene.initial_map() {
        Some(map) => Some(MapperMessage::Map(map)),
        None => (sequence.sensor != Sensor::Rgbd).then(|| MapperMessage::Points(scene.thinned_points())),
    };
    if first.is_some_and(|message| mapper.send(message).is_err()) {
        return summary;
    }
    if let Some(refined) = scene.refined() {
        summary.trajectory.clone_from(&refined.trajectory);
    }
    let mut world_from_camera = None;
    for QueuedFrame { frame, .. } in frames {
        let started = Instant::now();
        let known = follower.pose(&frame);
        let mut keyframe = None;
        if let Some(world_from_camera) = known {
            if scene.refined().is_none() {
                summary.trajectory.push((frame.index, StampedPose { timestamp_s: frame.timestamp_s, world_from_camera }));
            }
            if let Some(image_only) = follower.image_only(&frame, &world_from_camera) {
                keyframe = Some(guarded("tracking", || Ok(follower.make_keyframe(&frame, world_from_camera, image_only))));
            }
        }
        let times = StageTimes { features_ms: started.elapsed().as_secs_f64() * 1e3, ..StageTimes::default() };
        summary.frames.push(FrameRecord { frame: frame.index, lost: known.is_none(), times });
        let (frames_done, keyframes) = (frame.index + 1, follower.keyframes.len());
        world_from_camera = known.or(world_from_camera);
        let (lost, frame_ms) = (known.is_none(), times.total_ms());
        progress.tracking().put(TrackingProgress { frames_done, keyframes, lost, world_from_camera, frame_ms });
        show_image(progress, &frame);
        if progress.poses().is_wanted() {
            progress.poses().put(follower.poses());
        }
        let message = match keyframe.transpose() {
            Ok(keyframe) => keyframe.map(|keyframe| MapperMessage::Keyframe(Box::new(keyframe))),
            Err(error) => {
                summary.error = Some(error);
                break;
            }
        };
        if !sender.retry() || !message.is_none_or(|message| sender.send(message)) {
            break;
        }
    }
    summary.deferred = sender.finish(Vec::new(), Vec::new());
    progress.poses().put(follower.poses());
    summary.keyframes = follower.poses().keyframes;
    summary.images = follower.images;
    summary
}
