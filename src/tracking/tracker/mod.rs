//! The tracker: one frame at a time to a pose, and now and then a keyframe. Owns the map; runs in the caller's thread, with bundle
//! adjustment in a thread of its own.
//!
//! It leaves out what the rest of the project does elsewhere: rendering.

mod adjusting;
mod closing;
mod dense_prior;
mod frames;
mod keyframe_selection;
mod localising;
mod sightings;
mod start;
mod submaps;
mod velocity;

use std::sync::Arc;
use std::time::Instant;

use adjusting::Adjusting;
use closing::Closing;
use frames::{Frames, Record};
pub use keyframe_selection::is_image_due;
use localising::FRESHLY_FOUND_FRAMES;
use sightings::Sightings;
use velocity::Velocity;

use crate::geometry::{Camera, Se3, StampedPose};
use crate::sequence::{Frame, Sensor};
use crate::tracking::adjustment::local_bundle::Adjustment;
use crate::tracking::features::dense_frame::DenseFrame;
use crate::tracking::front_end::{ExtractedFrame, FrontEnd};
use crate::tracking::initialisation::mono::FirstView;
use crate::tracking::localisation::localise::{LastFrame, Localised};
use crate::tracking::loop_closing::{ClosedLoop, LoopCloser};
use crate::tracking::map::insertion;
use crate::tracking::map::sparse_map::{Keyframe, Map};
use crate::tracking::map::triangulation;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::depth_bias::DepthBias;
use crate::tracking::worker::Worker;
use crate::tracking::{KeyframePose, NewKeyframe, StageTimes, TrackedFrame, TrackingConfig, TrackingError, TrackingState};

/// Below this many inliers, the alignment of all pixels is a prior of the pose, where there is depth. Such keyframes keep their pixels.
const FEW_INLIERS: usize = 200;
/// Frames with fewer inliers say nothing of the noise.
const NOISE_INLIERS: usize = 30;
/// Without depth, keyframes further apart are worth more: a window then spans a wider baseline, which is all that fixes the points.
const MONO_SPACING: f64 = 1.65;

/// The tracker, for any sensor.
#[derive(Debug)]
pub struct Tracker {
    rig: Rig,
    sensor: Sensor,
    front_end: FrontEnd,
    map: Map,
    loops: LoopCloser,
    /// The frame that a map without depth may start from.
    first_view: Option<FirstView>,
    motion: Motion,
    lostness: Lostness,
    dense: DenseState,
    frames_seen: usize,
    /// Timestamp of the frame before, and its distance from the one before it, seconds.
    arrival: Option<(f64, Option<f64>)>,
    records: Vec<Record>,
    frames: Frames,
    adjusting: Adjusting,
    closing: Closing,
    /// Keyframes that moved since the last tracked frame, and the factor by which lengths around each have grown.
    moved: Vec<(usize, f64)>,
}

/// The last pose and the constant-velocity motion model.
#[derive(Debug, Default)]
struct Motion {
    /// The last frame with a pose; `None` before the map is started.
    last: Option<LastFrame>,
    /// That of the last two consecutive frames.
    velocity: Option<Velocity>,
    /// Keyframe that shares most landmarks with the last frame.
    reference: usize,
}

/// Whether the camera is lost, and for how long.
#[derive(Debug)]
struct Lostness {
    is_lost: bool,
    /// Consecutive frames without a pose, missing ones among them.
    frames_lost: usize,
    /// Frames with a pose since relocalisation.
    frames_since_found: usize,
}

/// Reference frames of dense RGB-D alignment.
#[derive(Debug, Default)]
struct DenseState {
    last: Option<Arc<DenseFrame>>,
    /// The newest keyframe's id and pixels.
    keyframe: Option<(usize, Arc<DenseFrame>)>,
}

impl Tracker {
    /// A tracker for one camera.
    ///
    /// # Errors
    /// [`TrackingError::Config`] if a setting is out of its range, [`TrackingError::Spawn`] if the system gives no thread.
    pub fn new(camera: Camera, sensor: Sensor, config: &TrackingConfig) -> Result<Self, TrackingError> {
        config.validate().map_err(TrackingError::Config)?;
        let spacing = if sensor == Sensor::Mono { MONO_SPACING } else { 1.0 };
        let pinhole = camera.pinhole;
        let front_end = FrontEnd::new(camera, sensor, config);
        let config = TrackingConfig {
            keyframe_translation: spacing * config.keyframe_translation,
            keyframe_rotation_rad: spacing * config.keyframe_rotation_rad,
            ..config.clone()
        };
        let steps = config.bundle_iterations;
        let solve = move |adjustment: &mut Adjustment| adjustment.solve(&pinhole, steps);
        let worker = Worker::start("adjusting", solve)?;
        Ok(Self {
            rig: Rig::new(pinhole, config),
            sensor,
            front_end,
            dense: DenseState::default(),
            map: Map::default(),
            loops: LoopCloser::default(),
            first_view: None,
            motion: Motion::default(),
            lostness: Lostness { is_lost: false, frames_lost: 0, frames_since_found: FRESHLY_FOUND_FRAMES },
            frames_seen: 0,
            arrival: None,
            records: Vec::new(),
            frames: Frames::default(),
            adjusting: Adjusting::new(worker),
            closing: Closing::start(pinhole, steps)?,
            moved: Vec::new(),
        })
    }

    /// Real-time replay: the result of bundle adjustment is applied when it is ready instead of at a fixed frame, so the poses depend on
    /// the machine's speed.
    #[must_use]
    pub fn real_time(mut self, real_time: bool) -> Self {
        self.adjusting.real_time = real_time;
        self
    }

    /// Extracts and tracks the next frame. With a [`FrontEnd`] of their own other threads can extract frames ahead.
    ///
    /// # Errors
    /// Those of [`FrontEnd::extract`] and [`Self::track_extracted`].
    pub fn track(&mut self, frame: &Frame, may_be_keyframe: bool) -> Result<TrackedFrame, TrackingError> {
        let extracted = self.front_end.extract(frame)?;
        self.track_extracted(&extracted, may_be_keyframe)
    }

    /// Tracks the next frame. `may_be_keyframe` is false for frames that are held out from the mapper; until there is a map, such
    /// frames are Lost.
    ///
    /// # Errors
    /// [`TrackingError::FirstFrameWithoutDepth`] for an RGB-D camera, [`TrackingError::Adjusting`] if the adjustment panicked.
    pub fn track_extracted(&mut self, frame: &ExtractedFrame, may_be_keyframe: bool) -> Result<TrackedFrame, TrackingError> {
        if self.frames_seen == 0 && self.sensor == Sensor::Rgbd && !frame.has_depth_image {
            return Err(TrackingError::FirstFrameWithoutDepth { frame: frame.index });
        }
        self.frames_seen += 1;
        self.lostness.frames_lost += self.missing_before(frame);
        let mut times = StageTimes { features_ms: frame.features_ms, ..StageTimes::default() };
        let adjusted = self.take_adjusted(&mut times)?;
        self.take_closed(adjusted, &mut times)?;
        let clock = Instant::now();
        self.settle_old_frames();
        times.bundle_ms += milliseconds(clock);
        let mut tracked = match self.motion.last.take() {
            Some(last) => self.go_on(frame, last, may_be_keyframe, times)?,
            None if self.sensor == Sensor::Mono => self.start_without_depth(frame, may_be_keyframe, times),
            None => self.start(frame, may_be_keyframe, times),
        };
        if tracked.state == TrackingState::Tracking {
            self.keep_dense(frame.dense.clone(), tracked.keyframe.as_ref().is_some_and(|k| !k.image_only));
        }
        tracked.updates = self.updates();
        Ok(tracked)
    }

    /// Tracks a frame when there is a map.
    fn go_on(
        &mut self,
        frame: &ExtractedFrame,
        last: LastFrame,
        may_be_keyframe: bool,
        mut times: StageTimes,
    ) -> Result<TrackedFrame, TrackingError> {
        let clock = Instant::now();
        let mut found = self.localise(&frame.features, &last);
        if found.as_ref().is_none_or(|f| f.inliers < FEW_INLIERS) {
            let guess = found.as_ref().map(|f| f.camera_from_world);
            found = self.localise_densely(frame, &last, guess).or(found);
        }
        times.localise_ms = milliseconds(clock);
        if let Some(found) = found {
            return self.accept(frame, &last, found, may_be_keyframe, times);
        }
        self.motion.last = Some(last);
        self.lose(frame, may_be_keyframe, times)
    }

    /// Final pose of every tracked frame (index in the sequence, pose), each carried by its reference keyframe so that later
    /// corrections of keyframes move it. Lost frames are absent, and those of submaps that never joined the largest one.
    pub fn trajectory(&self) -> Vec<(usize, StampedPose)> {
        let largest = self.largest_submap();
        self.records
            .iter()
            .filter(|r| self.map.keyframes[r.reference].root == largest)
            .map(|r| (r.frame_index, StampedPose { timestamp_s: r.timestamp_s, world_from_camera: r.pose(&self.map).inverse() }))
            .collect()
    }

    /// The keyframes of the largest submap with their current poses.
    pub fn keyframes(&self) -> Vec<KeyframePose> {
        let pose = |k: &Keyframe| KeyframePose {
            frame_index: k.frame_index,
            timestamp_s: k.timestamp_s,
            world_from_camera: k.camera_from_world.inverse(),
        };
        let largest = self.largest_submap();
        self.map.keyframes.iter().filter(|k| k.root == largest).map(pose).collect()
    }

    /// Loops closed so far, submaps joined among them.
    pub fn loops(&self) -> Vec<ClosedLoop> {
        let id = |k: usize| self.map.keyframes[k].frame_index;
        let loops = self.loops.loops().into_iter();
        loops.map(|closed| ClosedLoop { keyframe: id(closed.keyframe), place: id(closed.place), ..closed }).collect()
    }

    /// Bias of the depth images; `None` if it is not estimated.
    pub fn depth_bias(&self) -> Option<DepthBias> {
        self.seeks_bias().then_some(self.rig.depth_bias)
    }

    /// Standard deviation of a keypoint's coordinates, pixels at the finest pyramid level: as configured, or as the frames so far show it.
    pub fn pixel_sigma(&self) -> f64 {
        self.rig.pixel_noise.sigma()
    }

    /// How many keyframes there have been, of all submaps.
    pub fn keyframe_count(&self) -> usize {
        self.map.keyframes.len()
    }

    pub(in crate::tracking) fn map(&self) -> &Map {
        &self.map
    }

    /// Host memory of the tracker's map, bytes, as `tracking.max_host_bytes` bounds it.
    pub fn map_bytes(&self) -> u64 {
        self.map.bytes() + self.frame_bytes()
    }

    /// How many keyframes have not been culled.
    pub fn living_keyframes(&self) -> usize {
        self.map.living.len()
    }

    /// Takes a trusted pose in: motion, reference, record, and a keyframe if one is due.
    fn accept(
        &mut self,
        frame: &ExtractedFrame,
        last: &LastFrame,
        found: Localised,
        may_be_keyframe: bool,
        mut times: StageTimes,
    ) -> Result<TrackedFrame, TrackingError> {
        if self.rig.config.pixel_noise && found.inliers >= NOISE_INLIERS {
            self.rig.pixel_noise.observe(found.median_squared);
        }
        self.lostness.frames_since_found = if self.lostness.is_lost { 0 } else { self.lostness.frames_since_found + 1 };
        let motion = found.camera_from_world * last.camera_from_world.inverse();
        self.motion.velocity = (!self.lostness.is_lost).then(|| Velocity { motion, interval_s: self.interval_s() });
        self.lostness.is_lost = false;
        self.lostness.frames_lost = 0;
        self.first_view = None;
        let covisibility = self.map.covisibility(found.landmarks.iter().flatten().copied());
        self.motion.reference = covisibility.first().map_or(self.motion.reference, |(k, _)| *k);
        let features = frame.features.clone();
        let due =
            may_be_keyframe && keyframe_selection::is_due(&self.map, &features, &found, self.motion.reference, &self.rig.config);
        let is_held = found.is_held();
        let Localised { camera_from_world, landmarks, inliers, relative_pose, .. } = found;
        let camera_from_reference = self.map.keyframes[self.motion.reference].relative(&camera_from_world);
        let sightings = match is_held {
            true => Sightings::new(&features, &landmarks, &self.map, &self.rig).with_relative_pose(relative_pose),
            false => Sightings::default(),
        };
        self.record(frame, self.motion.reference, camera_from_reference, sightings);
        let motion = |before: &Se3| {
            let between = [before, &camera_from_world];
            keyframe_selection::motion(&self.map, &features, between, self.motion.reference, &self.rig.config)
        };
        let image_due = may_be_keyframe && !due && is_held && self.is_image_due(motion);
        self.motion.last = Some(LastFrame { features, camera_from_world, landmarks });
        let new_keyframe = match (due, image_due) {
            (true, _) => self.make_keyframe(frame, inliers, is_held, &mut times)?,
            (false, true) => self.make_image_only(),
            (false, false) => None,
        };
        Ok(TrackedFrame {
            state: TrackingState::Tracking,
            world_from_camera: self.motion.last.as_ref().map(|l| l.camera_from_world.inverse()),
            inliers,
            keyframe: new_keyframe,
            updates: Vec::new(),
            times,
        })
    }

    /// Makes the frame that was just tracked a keyframe. `held`: by landmarks, instead of by all pixels.
    fn make_keyframe(
        &mut self,
        frame: &ExtractedFrame,
        inliers: usize,
        held: bool,
        times: &mut StageTimes,
    ) -> Result<Option<NewKeyframe>, TrackingError> {
        self.finish_adjustment_before_keyframe(times)?;
        let Some(LastFrame { features, camera_from_world, landmarks }) = self.motion.last.take() else { return Ok(None) };
        let clock = Instant::now();
        let root = self.map.keyframes[self.motion.reference].root;
        let dense = frame.dense.clone().filter(|_| inliers < FEW_INLIERS);
        let relative_poses =
            dense.as_ref().map_or(Vec::new(), |dense| self.relative_poses(dense, &camera_from_world, &landmarks));
        let held = held || !relative_poses.is_empty();
        let keyframe = Keyframe::new(frame.index, frame.timestamp_s, camera_from_world, features.clone());
        let keyframe = Keyframe { root, landmarks, dense, relative_poses, ..keyframe };
        let id = insertion::insert_keyframe(&mut self.map, keyframe, &self.rig);
        triangulation::triangulate_with_neighbours(&mut self.map, id, &self.rig);
        insertion::fuse_with_neighbours(&mut self.map, id, &self.rig);
        insertion::cull_recent_landmarks(&mut self.map, id);
        self.map.refresh_neighbours(id);
        times.mapping_ms += milliseconds(clock);
        self.motion.reference = id;
        self.records.pop();
        self.record(frame, id, Se3::identity(), Sightings::default());
        self.note_mapped();
        self.motion.last = Some(LastFrame { features, camera_from_world, landmarks: self.map.keyframes[id].landmarks.clone() });
        self.adjust_around(id, held, times)?;
        // Its pose and its landmarks' depths go out with itself.
        self.moved.retain(|(moved, _)| *moved != id);
        Ok(Some(self.describe(id)))
    }

    /// The keyframe's message to the mapper.
    fn describe(&self, id: usize) -> NewKeyframe {
        let keyframe = &self.map.keyframes[id];
        let depth = |l: usize| (keyframe.camera_from_world * self.map.position(l)).z;
        let pairs = keyframe.features.features.iter().zip(&keyframe.landmarks);
        let seen = match self.sensor {
            Sensor::Rgbd => Vec::new(),
            _ => pairs.filter_map(|(f, l)| l.map(|l| (f.pixel, depth(l)))).filter(|(_, z)| *z > 0.0).collect(),
        };
        let world_from_camera = keyframe.camera_from_world.inverse();
        let covisible =
            self.map.covisible(id).into_iter().map(|(k, shared)| (self.map.keyframes[k].frame_index, shared)).collect();
        NewKeyframe { id: keyframe.frame_index, world_from_camera, seen, covisible, image_only: false }
    }

    fn record(&mut self, frame: &ExtractedFrame, reference: usize, camera_from_reference: Se3, sightings: Sightings) {
        let (frame_index, timestamp_s) = (frame.index, frame.timestamp_s);
        self.records.push(Record { frame_index, timestamp_s, reference, camera_from_reference, sightings });
    }
}

fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}
