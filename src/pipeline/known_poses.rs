//! Replaces tracking where the recording provides poses.
//!
//! Photos become keyframes all, frames of a moving camera by the tracker's keyframe thresholds; held-out ones never.
//! Frames without a pose count as lost. Where the recording has no depth, its points begin the map, and the world's unit is theirs.

use std::collections::HashSet;
use std::time::Instant;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::progress::{TrackingProgress, guarded};
use super::track_thread::{KeyframeSender, TrackSummary, TrackThread};
use crate::geometry::{Se3, StampedPose};
use crate::mapping::{DepthSource, Keyframe, MapperMessage, MappingConfig};
use crate::recording::Recording;
use crate::run_folder::FrameRecord;
use crate::sequence::{Frame, FrameEntry, KnownPoint, Rectifiers, Sensor};
use crate::splat::ViewCamera;
use crate::tracking::{KeyframePose, StageTimes};

/// Median depth for which the mapper's lengths are chosen, metres: that of a room.
const USUAL_DISTANCE_METRES: f64 = 2.0;
/// Cameras and points that are looked at for the scene's own distance: enough for a median.
const SAMPLED_CAMERAS: usize = 50;
const SAMPLED_POINTS: usize = 2000;
/// Neighbours that a keyframe names.
const COVISIBLE: usize = 10;

/// Units of the recording's world per metre: 1 where depth is measured, else such that the points' median distance is that of a room.
fn units_per_metre(recording: &Recording) -> f64 {
    if recording.sequence().sensor == Sensor::Rgbd {
        return 1.0;
    }
    scene_distance(recording).map_or(1.0, |distance| distance / USUAL_DISTANCE_METRES)
}

/// Median depth of the points in the cameras that have them in view.
fn scene_distance(recording: &Recording) -> Option<f64> {
    let sequence = recording.sequence();
    let sample = |len: usize, most: usize| (0..len).step_by(len.div_ceil(most).max(1));
    let mut depths = Vec::new();
    for index in sample(sequence.entries.len(), SAMPLED_CAMERAS) {
        let Some(world_from_camera) = recording.known_pose(sequence.entries[index].timestamp_s) else { continue };
        let pinhole = &sequence.camera_of(index).pinhole;
        let camera_from_world = world_from_camera.inverse();
        for point in sample(sequence.points.len(), SAMPLED_POINTS).map(|i| &sequence.points[i]) {
            let p_in_camera = (camera_from_world * Point3::from(point.position)).coords;
            let seen = pinhole.project(&p_in_camera).is_some_and(|pixel| pinhole.contains(&pixel, 0.0));
            depths.extend(seen.then_some(p_in_camera.z));
        }
    }
    median(depths)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The points that begin the map: of those that share a cube of `mapping.points.spacing_pixels` in the nearest view, the first. Denser ones
/// would only cost time. Points that no frame sees are left out.
fn thinned_points(recording: &Recording) -> Vec<KnownPoint> {
    let (sequence, config) = (recording.sequence(), recording.config());
    let camera = |(index, entry): (usize, &FrameEntry)| {
        let camera_from_world = recording.known_pose(entry.timestamp_s)?.inverse();
        Some(ViewCamera { pinhole: sequence.camera_of(index).pinhole, camera_from_world })
    };
    let cameras: Vec<ViewCamera> = sequence.entries.iter().enumerate().filter_map(camera).collect();
    let spacing_pixels = f64::from(config.mapping.points.spacing_pixels) / config.map_scale;
    let cell = |point: &KnownPoint| {
        let pixel_size = |ViewCamera { pinhole, camera_from_world }: &ViewCamera| {
            let p_in_camera = (camera_from_world * Point3::from(point.position)).coords;
            let seen = pinhole.project(&p_in_camera).is_some_and(|pixel| pinhole.contains(&pixel, 0.0));
            seen.then_some(p_in_camera.z / pinhole.fx)
        };
        let nearest = cameras.iter().filter_map(pixel_size).min_by(f64::total_cmp)?;
        // Sides are powers of two, so that cubes of like distances are the same ones.
        let level = (nearest * spacing_pixels).log2().round();
        Some((level as i64, point.position.map(|v| (v / level.exp2()).floor() as i64)))
    };
    let cells: Vec<Option<(i64, Vector3<i64>)>> = sequence.points.par_iter().map(cell).collect();
    let mut taken = HashSet::new();
    let first = |cell: Option<(i64, Vector3<i64>)>| cell.is_some_and(|cell| taken.insert(cell));
    let keep: Vec<bool> = cells.into_iter().map(first).collect();
    sequence.points.iter().zip(keep).filter(|(_, keep)| *keep).map(|(point, _)| *point).collect()
}

/// The mapper's configuration for a recording.
pub(super) fn mapping_config(recording: &Recording) -> MappingConfig {
    mapping_config_in_units(recording, &recording.config().mapping)
}

/// A variant of the mapper's configuration, its lengths in the unit of the recording's world.
pub(super) fn mapping_config_in_units(recording: &Recording, mapping: &MappingConfig) -> MappingConfig {
    if recording.config().replay.known_poses { mapping.in_units(units_per_metre(recording) as f32) } else { mapping.clone() }
}

/// A keyframe so far.
struct Known {
    pose: KeyframePose,
    /// Median distance of what it sees, in the world's unit.
    distance: f64,
}

struct Follower<'a> {
    recording: &'a Recording,
    rectifiers: Rectifiers,
    keyframes: Vec<Known>,
    /// Where frames have no depth.
    scene_distance: f64,
}

impl Follower<'_> {
    /// How far apart two views are: 1 where a keyframe is due, by distance or by angle.
    fn apart(&self, a: &Known, world_from_camera: &Se3) -> f64 {
        let a_from_camera = a.pose.world_from_camera.inverse() * world_from_camera;
        let moved =
            a_from_camera.translation.vector.norm() / (self.recording.config().tracking.keyframe_translation * a.distance);
        moved.max(a_from_camera.rotation.angle() / self.recording.config().tracking.keyframe_rotation_rad)
    }

    fn is_due(&self, index: usize, world_from_camera: &Se3) -> bool {
        let photos = self.recording.sequence().layout.is_photos();
        let far = |last: &Known| self.apart(last, world_from_camera) >= 1.0;
        !self.recording.config().replay.is_held_out(index) && (photos || self.keyframes.last().is_none_or(far))
    }

    /// The nearest keyframes, nearest first.
    fn covisible(&self, world_from_camera: &Se3) -> Vec<usize> {
        let mut nearest: Vec<(f64, usize)> =
            self.keyframes.iter().map(|known| (self.apart(known, world_from_camera), known.pose.id)).collect();
        nearest.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        nearest.into_iter().take(COVISIBLE).map(|(_, id)| id).collect()
    }

    fn make_keyframe(&mut self, frame: &Frame, world_from_camera: Se3) -> Keyframe {
        let image = self.rectifiers.of(self.recording.sequence().camera_of(frame.index)).rectify(frame);
        let (id, covisible) = (self.keyframes.len(), self.covisible(&world_from_camera));
        let pose = KeyframePose { id, frame_index: frame.index, timestamp_s: frame.timestamp_s, world_from_camera };
        let distance = image.median_depth_metres().unwrap_or(self.scene_distance);
        self.keyframes.push(Known { pose, distance });
        Keyframe { id, world_from_camera, image, depth_source: DepthSource::Sensor, covisible }
    }
}

/// Sends keyframes at their known poses until the frames end, or the mapper closes the channel.
pub(super) fn follow(thread: &TrackThread<'_>) -> TrackSummary {
    let TrackThread { recording, frames, mapper, progress } = *thread;
    let (sequence, config) = (recording.sequence(), recording.config());
    let mut summary = TrackSummary::default();
    let mut sender = KeyframeSender::new(mapper, config.replay.real_time);
    let rectifiers = Rectifiers::new(config.map_scale);
    let scene_distance = scene_distance(recording).unwrap_or(USUAL_DISTANCE_METRES);
    let mut follower = Follower { recording, rectifiers, keyframes: Vec::new(), scene_distance };
    if sequence.sensor != Sensor::Rgbd && mapper.send(MapperMessage::Points(thinned_points(recording))).is_err() {
        return summary;
    }
    for frame in frames {
        let started = Instant::now();
        let known = recording.known_pose(frame.timestamp_s);
        let mut keyframe = None;
        if let Some(world_from_camera) = known {
            summary.trajectory.push((frame.index, StampedPose { timestamp_s: frame.timestamp_s, world_from_camera }));
            if follower.is_due(frame.index, &world_from_camera) {
                keyframe = Some(guarded("tracking", || Ok(follower.make_keyframe(&frame, world_from_camera))));
            }
        }
        let times = StageTimes { features_ms: started.elapsed().as_secs_f64() * 1e3, ..StageTimes::default() };
        summary.frames.push(FrameRecord { frame: frame.index, lost: known.is_none(), times });
        let (frames_done, keyframes) = (frame.index + 1, follower.keyframes.len());
        progress.tracking.force_push(TrackingProgress { frames_done, keyframes, lost: known.is_none() });
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
    summary.deferred = sender.finish();
    summary.keyframes = follower.keyframes.iter().map(|known| known.pose).collect();
    summary
}
