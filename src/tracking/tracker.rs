//! The tracker: one frame at a time to a pose, and now and then a keyframe. Owns the map; runs in the caller's thread.
//!
//! It leaves out what the rest of the project does elsewhere: rendering.

use std::sync::Arc;
use std::time::Instant;

use super::features::Extractor;
use super::frame_features::FrameFeatures;
use super::keyframe;
use super::localise::{Context, Localised};
use super::loop_closing::LoopCloser;
use super::map::{Keyframe, Map};
use super::{KeyframePose, NewKeyframe, StageTimes, TrackedFrame, TrackingConfig, TrackingError, TrackingState, mapping, window};
use crate::geometry::{Camera, Se3, StampedPose};
use crate::sequence::Frame;

/// For this many frames after the camera was found again, poses are held to the stricter count.
const FRESHLY_FOUND_FRAMES: usize = 5;

/// A true pose agrees with well over half of its matches, one by chance with few.
const MIN_INLIER_SHARE: f64 = 0.35;

/// RGB-D tracker.
#[derive(Debug)]
pub struct Tracker {
    camera: Camera,
    config: TrackingConfig,
    extractor: Extractor,
    map: Map,
    loops: LoopCloser,
    /// The last frame with a pose; `None` before the map is started.
    last: Option<LastFrame>,
    /// camera_from_last_camera, as of the last two frames in a row.
    velocity: Option<Se3>,
    /// Keyframe that shares most landmarks with the last frame.
    reference: usize,
    lost: bool,
    frames_since_found: usize,
    frames_seen: usize,
    records: Vec<Record>,
}

/// The last frame that has a pose.
#[derive(Clone, Debug)]
pub struct LastFrame {
    pub features: Arc<FrameFeatures>,
    pub camera_from_world: Se3,
    /// The living landmark that each feature shows.
    pub landmarks: Vec<Option<usize>>,
}

/// A tracked frame, held by its reference keyframe.
#[derive(Clone, Copy, Debug)]
struct Record {
    frame_index: usize,
    timestamp_s: f64,
    reference: usize,
    camera_from_reference: Se3,
}

impl Tracker {
    /// A tracker for one camera.
    ///
    /// # Errors
    /// [`TrackingError::Config`] if a setting is out of its range.
    pub fn new(camera: Camera, config: &TrackingConfig) -> Result<Self, TrackingError> {
        config.validate().map_err(TrackingError::Config)?;
        Ok(Self {
            camera,
            config: config.clone(),
            extractor: Extractor::new(camera.pinhole.width, camera.pinhole.height, config),
            map: Map::default(),
            loops: LoopCloser::default(),
            last: None,
            velocity: None,
            reference: 0,
            lost: false,
            frames_since_found: FRESHLY_FOUND_FRAMES,
            frames_seen: 0,
            records: Vec::new(),
        })
    }

    /// Tracks the next frame. `may_be_keyframe` is false for frames that are held out from the mapper; until there is a map, such
    /// frames are Lost.
    ///
    /// # Errors
    /// If the very first frame has no depth, if an image's size is not the camera's, or if OpenCV fails.
    pub fn track(&mut self, frame: &Frame, may_be_keyframe: bool) -> Result<TrackedFrame, TrackingError> {
        self.check(frame)?;
        self.frames_seen += 1;
        let mut times = StageTimes::default();
        let clock = Instant::now();
        let features = Arc::new(FrameFeatures::of_frame(frame, &self.camera, &self.extractor, &self.config)?);
        times.features_ms = milliseconds(clock);
        let Some(last) = self.last.take() else {
            return Ok(self.start(frame, features, may_be_keyframe, times));
        };
        let clock = Instant::now();
        let found = self.localise(&features, &last);
        times.localise_ms = milliseconds(clock);
        let tracked = match found {
            Some(found) => self.accept(frame, features, &last, found, may_be_keyframe, times),
            None => {
                self.last = Some(last);
                self.lost = true;
                self.velocity = None;
                TrackedFrame::lost(times)
            }
        };
        Ok(tracked)
    }

    /// Final pose of every tracked frame (index in the sequence, pose), each carried by its reference keyframe so that later
    /// corrections of keyframes move it. Lost frames are absent.
    pub fn trajectory(&self) -> Vec<(usize, StampedPose)> {
        let pose = |r: &Record| (r.camera_from_reference * self.map.keyframes[r.reference].camera_from_world).inverse();
        self.records
            .iter()
            .map(|r| (r.frame_index, StampedPose { timestamp_s: r.timestamp_s, world_from_camera: pose(r) }))
            .collect()
    }

    /// All keyframes with their current poses; a keyframe's id is its place.
    pub fn keyframes(&self) -> Vec<KeyframePose> {
        let pose = |(id, k): (usize, &Keyframe)| KeyframePose {
            id,
            frame_index: k.frame_index,
            timestamp_s: k.timestamp_s,
            world_from_camera: k.camera_from_world.inverse(),
        };
        self.map.keyframes.iter().enumerate().map(pose).collect()
    }

    fn check(&self, frame: &Frame) -> Result<(), TrackingError> {
        let (width, height) = (self.camera.pinhole.width, self.camera.pinhole.height);
        let size = |what, (found_width, found_height)| {
            let good = (found_width, found_height) == (width, height);
            let error = TrackingError::Size { frame: frame.index, what, width, height, found_width, found_height };
            if good { Ok(()) } else { Err(error) }
        };
        size("colour", frame.color.dimensions())?;
        match &frame.depth {
            Some(depth) => size("depth", (depth.width, depth.height)),
            None if self.frames_seen == 0 => Err(TrackingError::FirstFrameWithoutDepth { frame: frame.index }),
            None => Ok(()),
        }
    }

    /// Starts the map with a frame that shows enough.
    fn start(&mut self, frame: &Frame, features: Arc<FrameFeatures>, may: bool, times: StageTimes) -> TrackedFrame {
        let with_depth = features.features.iter().filter(|f| f.depth_metres.is_some()).count();
        if !may || with_depth < self.config.min_initial_landmarks {
            return TrackedFrame::lost(times);
        }
        let keyframe = Keyframe {
            frame_index: frame.index,
            timestamp_s: frame.timestamp_s,
            camera_from_world: Se3::identity(),
            features: features.clone(),
            landmarks: Vec::new(),
        };
        let id = mapping::insert_keyframe(&mut self.map, keyframe, &self.camera.pinhole, &self.config);
        let landmarks = self.map.keyframes[id].landmarks.clone();
        self.last = Some(LastFrame { features, camera_from_world: Se3::identity(), landmarks });
        self.record(frame, id, Se3::identity());
        TrackedFrame {
            state: TrackingState::Tracking,
            world_from_camera: Some(Se3::identity()),
            inliers: with_depth,
            keyframe: Some(NewKeyframe { id, world_from_camera: Se3::identity(), covisible: Vec::new() }),
            updates: Vec::new(),
            times,
        }
    }

    /// The frame's pose, if it can be trusted.
    fn localise(&mut self, features: &FrameFeatures, last: &LastFrame) -> Option<Localised> {
        let strict = self.lost || self.frames_since_found < FRESHLY_FOUND_FRAMES;
        let needed = if strict { self.config.min_relocalisation_inliers } else { self.config.min_inliers };
        let reference = self.reference;
        let predicted = self.velocity.unwrap_or_default() * last.camera_from_world;
        let mut context = Context { map: &mut self.map, pinhole: &self.camera.pinhole, config: &self.config };
        let mut found = None;
        if !self.lost {
            let view = context.view_of_last(last);
            if let Some(start) = context.by_prediction(features, &view, &predicted) {
                found = Some(context.in_local_map(features, &start, reference)).filter(|f| f.inliers >= needed);
            }
            if found.is_none()
                && let Some(start) =
                    context.by_view(features, &view).or_else(|| context.by_view(features, &context.view_of_keyframe(reference)))
            {
                found = Some(context.in_local_map(features, &start, reference)).filter(|f| f.inliers >= needed);
            }
        }
        if found.is_none() {
            let needed = self.config.min_relocalisation_inliers;
            found = context.by_the_map(features, reference).filter(|f| f.inliers >= needed);
        }
        let trusted = |f: &Localised| {
            let finite = f.camera_from_world.to_homogeneous().iter().all(|v| v.is_finite());
            finite && f.inliers as f64 >= MIN_INLIER_SHARE * f.matches as f64
        };
        found.filter(trusted)
    }

    /// Takes a trusted pose in: motion, reference, record, and a keyframe if one is due.
    fn accept(
        &mut self,
        frame: &Frame,
        features: Arc<FrameFeatures>,
        last: &LastFrame,
        found: Localised,
        may_be_keyframe: bool,
        mut times: StageTimes,
    ) -> TrackedFrame {
        self.frames_since_found = if self.lost { 0 } else { self.frames_since_found + 1 };
        self.velocity = (!self.lost).then(|| found.camera_from_world * last.camera_from_world.inverse());
        self.lost = false;
        let votes = self.map.votes(found.landmarks.iter().flatten().copied());
        self.reference = votes.first().map_or(self.reference, |(k, _)| *k);
        let inliers = found.inliers;
        let due = may_be_keyframe && keyframe::is_due(&self.map, &features, &found, self.reference, &self.config);
        let (mut new_keyframe, mut updates) = (None, Vec::new());
        if due {
            let keyframe;
            (keyframe, updates) = self.make_keyframe(frame, features, found, &mut times);
            self.record(frame, keyframe.id, Se3::identity());
            new_keyframe = Some(keyframe);
        } else {
            let camera_from_reference = found.camera_from_world * self.map.keyframes[self.reference].camera_from_world.inverse();
            self.record(frame, self.reference, camera_from_reference);
            self.last = Some(LastFrame { features, camera_from_world: found.camera_from_world, landmarks: found.landmarks });
        }
        TrackedFrame {
            state: TrackingState::Tracking,
            world_from_camera: self.last.as_ref().map(|l| l.camera_from_world.inverse()),
            inliers,
            keyframe: new_keyframe,
            updates,
            times,
        }
    }

    fn make_keyframe(
        &mut self,
        frame: &Frame,
        features: Arc<FrameFeatures>,
        found: Localised,
        times: &mut StageTimes,
    ) -> (NewKeyframe, Vec<(usize, Se3)>) {
        let (pinhole, config) = (&self.camera.pinhole, &self.config);
        let clock = Instant::now();
        let keyframe = Keyframe {
            frame_index: frame.index,
            timestamp_s: frame.timestamp_s,
            camera_from_world: found.camera_from_world,
            features: features.clone(),
            landmarks: found.landmarks,
        };
        let id = mapping::insert_keyframe(&mut self.map, keyframe, pinhole, config);
        mapping::join_neighbours(&mut self.map, id, pinhole, config);
        mapping::remove_unproven(&mut self.map, id);
        times.mapping_ms = milliseconds(clock);
        let clock = Instant::now();
        let mut moved = window::adjust_window(&mut self.map, id, pinhole, config);
        times.bundle_ms = milliseconds(clock);
        let clock = Instant::now();
        if let Some(bent) = self.close_loop(id) {
            moved = bent;
        }
        times.loops_ms = milliseconds(clock);
        let pose = |k: usize| self.map.keyframes[k].camera_from_world;
        let updates = moved.into_iter().filter(|k| *k != id).map(|k| (k, pose(k).inverse())).collect();
        let camera_from_world = pose(id);
        self.reference = id;
        self.last = Some(LastFrame { features, camera_from_world, landmarks: self.map.keyframes[id].landmarks.clone() });
        (NewKeyframe { id, world_from_camera: camera_from_world.inverse(), covisible: self.map.covisible(id) }, updates)
    }

    /// Closes a loop if the newest keyframe shows one: returns the keyframes that may have moved. Frames follow their keyframes.
    fn close_loop(&mut self, keyframe: usize) -> Option<Vec<usize>> {
        let moved =
            self.config.loop_closing.then(|| self.loops.close(&mut self.map, keyframe, &self.camera.pinhole, &self.config))?;
        for (keyframe, growth) in &moved {
            let theirs = self.records.iter_mut().filter(|r| r.reference == *keyframe);
            theirs.for_each(|r| r.camera_from_reference.translation.vector *= *growth);
        }
        (!moved.is_empty()).then(|| moved.into_iter().map(|(k, _)| k).collect())
    }

    fn record(&mut self, frame: &Frame, reference: usize, camera_from_reference: Se3) {
        self.records.push(Record { frame_index: frame.index, timestamp_s: frame.timestamp_s, reference, camera_from_reference });
    }
}

fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}
