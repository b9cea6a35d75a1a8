//! Frames between keyframes: which of them become image-only keyframes, and their poses once the landmarks that they saw have settled.
//!
//! The tracker carries a frame by its reference keyframe. Bundle adjustment moves keyframe and landmarks in different ways; the pose is therefore
//! solved once more when it is over with both. With measured depth, their observations are kept as far as memory allows: the
//! adjustment at the end includes them, and the poses are solved again after it.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector2;
use rayon::prelude::*;

use super::{Tracker, keyframe_selection};
use crate::geometry::Se3;
use crate::sequence::Sensor;
use crate::tracking::adjustment::local_bundle::FrameView;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::map::sparse_map::{Keyframe, Map, SETTLED_AFTER};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose::{PoseObservation, PosePrior, optimise_pose};
use crate::tracking::solvers::relative_pose::RelativePose;
use crate::tracking::solvers::residual::Measurement;
use crate::tracking::{KeyframePose, NewKeyframe};

/// At each frame so many are, so that none takes long.
const SETTLED_A_FRAME: usize = 2;
/// Frames that may wait for it: a camera that stands still makes no keyframes.
const MOST_WAITING: usize = 256;
/// What settled frames saw takes at most this share of the tracker's host memory.
const SHARE_OF_HOST_BYTES: u64 = 8;
/// Share of the landmarks that must still be there, and agree.
const LEAST_AGREEING: f64 = 0.5;

/// A tracked frame, held by its reference keyframe.
#[derive(Clone, Debug)]
pub(super) struct Record {
    pub frame_index: usize,
    pub timestamp_s: f64,
    pub reference: usize,
    /// In the reference keyframe's unit of length.
    pub camera_from_reference: Se3,
    /// By which its pose is solved again.
    pub sightings: Sightings,
}

/// Landmarks that a frame saw.
#[derive(Clone, Debug, Default)]
pub(super) struct Sightings {
    seen: Vec<Sighting>,
    /// How many keyframes there were: later landmarks may have taken the places of these.
    known: usize,
    /// The frame's pose relative to a keyframe by all pixels, where landmarks were few.
    relative_pose: Option<Box<RelativePose>>,
}

/// A landmark where a frame saw it.
#[derive(Clone, Copy, Debug)]
struct Sighting {
    landmark: u32,
    pixel: [f32; 2],
    /// 1/metres; NaN without depth.
    inverse_depth: f32,
    /// Inverse standard deviations of pixel and inverse depth.
    weights: [f32; 2],
}

/// What is kept of frames between keyframes.
#[derive(Debug, Default)]
pub(super) struct Frames {
    /// Records before this one have been solved again.
    settled: usize,
    /// How often the sightings that these keep were halved in number, and their bytes.
    halvings: u32,
    kept_bytes: usize,
    /// The record of the last keyframe, image-only or not.
    mapped_last: Option<usize>,
    /// Records of image-only keyframes by their references, ascending.
    images: BTreeMap<usize, Vec<usize>>,
    /// Those whose poses were solved again since the last update.
    moved: BTreeSet<usize>,
}

impl Sightings {
    pub fn new(features: &FrameFeatures, landmarks: &[Option<usize>], map: &Map, rig: &Rig) -> Self {
        // No larger than needed: they stay for as long as the recording lasts.
        let mut seen = Vec::with_capacity(landmarks.iter().flatten().count());
        seen.extend(features.features.iter().zip(landmarks).filter_map(|(feature, landmark)| {
            let measured = rig.biased_measurement(feature);
            Some(Sighting {
                landmark: u32::try_from((*landmark)?).ok()?,
                pixel: [measured.pixel.x as f32, measured.pixel.y as f32],
                inverse_depth: measured.inverse_depth.map_or(f32::NAN, |inverse| inverse as f32),
                weights: [measured.pixel_weight as f32, measured.depth_weight as f32],
            })
        }));
        Self { seen, known: map.keyframes.len(), relative_pose: None }
    }

    pub fn with_relative_pose(self, relative_pose: Option<RelativePose>) -> Self {
        Self { relative_pose: relative_pose.map(Box::new), ..self }
    }

    fn bytes(&self) -> usize {
        self.seen.len() * size_of::<Sighting>() + self.relative_pose.as_deref().map_or(0, size_of_val)
    }

    /// Landmarks that are still there, and where they were measured.
    fn measured(&self, map: &Map) -> Vec<(usize, Measurement)> {
        let measured = |s: &Sighting| {
            let landmark = map.resolve_since(s.landmark as usize, self.known)?;
            let measurement = Measurement {
                pixel: Vector2::from(s.pixel.map(f64::from)),
                inverse_depth: (!s.inverse_depth.is_nan()).then_some(s.inverse_depth.into()),
                pixel_weight: s.weights[0].into(),
                depth_weight: s.weights[1].into(),
            };
            Some((landmark, measurement))
        };
        self.seen.iter().filter_map(measured).collect()
    }

    /// The relative pose, unless its keyframe was culled.
    fn living_relative_pose(&self, map: &Map) -> Option<&RelativePose> {
        self.relative_pose.as_deref().filter(|relative| map.living.contains(&relative.reference))
    }

    /// What it says of the frame's pose.
    fn prior(&self, map: &Map) -> Option<PosePrior> {
        let relative = self.living_relative_pose(map)?;
        Some(relative.prior(&map.keyframes[relative.reference].camera_from_world))
    }

    /// The same with their places, freed of the depth's bias.
    fn observations(&self, map: &Map, rig: &Rig) -> Vec<PoseObservation> {
        let observation = |(landmark, measured): (usize, Measurement)| {
            let measurement = measured.without_bias(&rig.pinhole, &rig.depth_bias);
            PoseObservation { point_in_world: map.position(landmark), measurement }
        };
        self.measured(map).into_iter().map(observation).collect()
    }
}

impl Record {
    /// camera_from_world.
    pub fn pose(&self, map: &Map) -> Se3 {
        map.keyframes[self.reference].carry(&self.camera_from_reference)
    }

    fn keyframe_pose(&self, map: &Map) -> KeyframePose {
        KeyframePose { frame_index: self.frame_index, timestamp_s: self.timestamp_s, world_from_camera: self.pose(map).inverse() }
    }

    /// Solves the pose by the landmarks as they are now; `false` for keyframes, and where too few are left or agree.
    fn settle(&mut self, map: &Map, rig: &Rig) -> bool {
        if map.keyframes[self.reference].frame_index == self.frame_index {
            return false;
        }
        let prior = self.sightings.prior(map);
        let found = optimise_pose(&rig.pinhole, &self.pose(map), prior.as_ref(), &self.sightings.observations(map, rig));
        let needed = (LEAST_AGREEING * self.sightings.seen.len() as f64).max(rig.config.min_inliers as f64);
        let agrees = found.inliers as f64 >= needed;
        if agrees {
            self.camera_from_reference = map.keyframes[self.reference].relative(&found.camera_from_world);
        }
        agrees
    }
}

impl Frames {
    /// Records of image-only keyframes whose reference is this one, ascending.
    pub fn images_of(&self, keyframe: usize) -> &[usize] {
        self.images.get(&keyframe).map_or(&[], Vec::as_slice)
    }

    /// Those whose poses were solved again since the last call.
    pub fn take_moved(&mut self) -> BTreeSet<usize> {
        std::mem::take(&mut self.moved)
    }
}

impl Tracker {
    /// Notes that the newest record is a keyframe's.
    pub(super) fn note_mapped(&mut self) {
        self.frames.mapped_last = self.records.len().checked_sub(1);
    }

    /// Whether the frame tracked last, which is no keyframe, is worth an image-only one; `motion` is its motion since a pose as a share of what a
    /// keyframe needs.
    pub(super) fn is_image_due(&self, motion: impl FnOnce(&Se3) -> f64) -> bool {
        let (Some(last), Some(record)) = (self.frames.mapped_last, self.records.last()) else { return false };
        let last = &self.records[last];
        let since_s = record.timestamp_s - last.timestamp_s;
        keyframe_selection::is_image_due(since_s, motion(&last.pose(&self.map)), &self.rig.config)
    }

    /// Makes the frame tracked last an image-only keyframe.
    pub(super) fn make_image_only(&mut self) -> Option<NewKeyframe> {
        self.note_mapped();
        let newest = self.frames.mapped_last?;
        let record = &self.records[newest];
        self.frames.images.entry(record.reference).or_default().push(newest);
        let KeyframePose { frame_index, world_from_camera, .. } = record.keyframe_pose(&self.map);
        Some(NewKeyframe { id: frame_index, world_from_camera, seen: Vec::new(), covisible: Vec::new(), image_only: true })
    }

    /// Solves the poses of frames whose landmarks bundle adjustment has left behind, a few at a time.
    pub(super) fn settle_old_frames(&mut self) {
        let end = self.map.keyframes.len().saturating_sub(SETTLED_AFTER);
        for _ in 0..SETTLED_A_FRAME {
            let is_old = self.records.get(self.frames.settled).is_some_and(|record| record.reference < end);
            if is_old || self.records.len() > self.frames.settled + MOST_WAITING {
                let moved = self.records[self.frames.settled].settle(&self.map, &self.rig);
                self.note_settled(moved);
            }
        }
    }

    /// Solves the poses of all frames that are left, on all cores.
    pub(super) fn settle_all_frames(&mut self) {
        let (map, rig) = (&self.map, &self.rig);
        let left = self.records[self.frames.settled..].par_iter_mut();
        let moved: Vec<bool> = left.map(|record| record.settle(map, rig)).collect();
        moved.into_iter().for_each(|moved| self.note_settled(moved));
    }

    /// Frames between the keyframes of a submap, for bundle adjustment: evenly, with so many observations at most.
    pub(super) fn frame_views(&self, root: usize, most_observations: usize) -> Vec<FrameView> {
        if !self.adjusts_frames() {
            return Vec::new();
        }
        let of_submap = |record: &&Record| self.map.keyframes[record.reference].root == root && !record.sightings.seen.is_empty();
        let records: Vec<&Record> = self.records.iter().filter(of_submap).collect();
        let observations: usize = records.iter().map(|record| record.sightings.seen.len()).sum();
        let every = observations.div_ceil(most_observations.max(1)).max(1);
        let view = |record: &&Record| FrameView {
            camera_from_world: record.pose(&self.map),
            seen: record.sightings.measured(&self.map),
            relative_pose: record.sightings.living_relative_pose(&self.map).copied(),
        };
        records.iter().step_by(every).map(view).collect()
    }

    /// Whether the adjustment at the end includes frames. Without measured depth, they change nothing.
    fn adjusts_frames(&self) -> bool {
        self.sensor != Sensor::Mono
    }

    /// Lets all frames that kept their sightings be solved once more.
    pub(super) fn unsettle_frames(&mut self) {
        (self.frames.settled, self.frames.kept_bytes) = (0, 0);
    }

    /// Memory of what settled frames saw, bytes.
    pub(super) fn frame_bytes(&self) -> u64 {
        self.frames.kept_bytes as u64
    }

    /// A settled record keeps its sightings, or gives them up; where all together are too many, every other record does.
    fn keep_or_drop_sightings(&mut self, settled: usize) {
        let most = (self.rig.config.max_host_bytes / SHARE_OF_HOST_BYTES) as usize;
        let kept = self.adjusts_frames();
        let frames = &mut self.frames;
        if !(kept && settled.is_multiple_of(1 << frames.halvings)) {
            self.records[settled].sightings = Sightings::default();
        }
        frames.kept_bytes += self.records[settled].sightings.bytes();
        while frames.kept_bytes > most && 1 << frames.halvings <= settled {
            let kept_every = 1 << frames.halvings;
            for record in self.records[..=settled].iter_mut().skip(kept_every).step_by(2 * kept_every) {
                frames.kept_bytes -= std::mem::take(&mut record.sightings).bytes();
            }
            frames.halvings += 1;
        }
    }

    /// Notes that the next frame has been solved, and whether its pose is another.
    fn note_settled(&mut self, moved: bool) {
        let settled = self.frames.settled;
        let record = &self.records[settled];
        if moved && self.frames.images_of(record.reference).binary_search(&settled).is_ok() {
            self.frames.moved.insert(settled);
        }
        self.keep_or_drop_sightings(settled);
        self.frames.settled += 1;
    }

    /// The image-only keyframes of the largest submap with their current poses, in order.
    pub fn image_only_keyframes(&self) -> Vec<KeyframePose> {
        let largest = self.largest_submap();
        self.image_only_where(|keyframe| keyframe.root == largest)
    }

    /// The image-only keyframes whose references fulfil a condition, in order.
    pub(super) fn image_only_where(&self, fulfils: impl Fn(&Keyframe) -> bool) -> Vec<KeyframePose> {
        let of = self.frames.images.iter().filter(|(reference, _)| fulfils(&self.map.keyframes[**reference]));
        let mut records: Vec<usize> = of.flat_map(|(_, records)| records.iter().copied()).collect();
        records.sort_unstable();
        records.into_iter().map(|record| self.records[record].keyframe_pose(&self.map)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Sim3, se3};
    use crate::tracking::tracker::adjusting::tests::tracker;
    use nalgebra::{Matrix6, Vector6};

    #[test]
    fn a_frame_is_solved_again_by_the_landmarks_as_they_are() {
        let Tracker { rig, mut map, .. } = tracker(Sensor::Rgbd, &Sim3::identity());
        let keyframe = &map.keyframes[2];
        let sightings = Sightings::new(&keyframe.features, &keyframe.landmarks, &map, &rig);
        let off = se3::exp(&Vector6::new(0.01, -0.005, 0.01, 0.003, 0.002, -0.004));
        let record = Record {
            frame_index: 7,
            timestamp_s: 0.7,
            reference: 1,
            camera_from_reference: map.keyframes[1].relative(&(off * keyframe.camera_from_world)),
            sightings,
        };
        let truth = keyframe.camera_from_world;
        let error = |record: &Record, map: &Map| se3::log(&(record.pose(map) * truth.inverse())).norm();
        let mut solved = record.clone();
        assert!(solved.settle(&map, &rig) && error(&solved, &map) < 0.2 * error(&record, &map), "{}", error(&solved, &map));
        // Its pixels pull it towards where they put it.
        let by_pixels = RelativePose {
            current: 0,
            reference: 1,
            current_from_reference: off * truth * map.keyframes[1].camera_from_world.inverse(),
            information: Matrix6::identity() * 1e6,
        };
        let sightings = record.sightings.clone().with_relative_pose(Some(by_pixels));
        let mut pulled = Record { sightings, ..record.clone() };
        assert!(pulled.settle(&map, &rig) && error(&pulled, &map) > 2.0 * error(&solved, &map), "{}", error(&pulled, &map));
        // Where most of the landmarks are gone, it stays with its reference.
        let seen: Vec<usize> = map.keyframes[2].landmarks.iter().flatten().copied().collect();
        seen.iter().skip(20).for_each(|landmark| map.remove_landmark(*landmark));
        let mut left = record.clone();
        assert!(!left.settle(&map, &rig) && error(&left, &map) == error(&record, &map));
    }

    #[test]
    fn frames_of_a_camera_that_stands_still_do_not_wait_for_ever() {
        let mut tracker = tracker(Sensor::Rgbd, &Sim3::identity());
        let newest = tracker.map.keyframes.len() - 1;
        let Keyframe { features, landmarks, .. } = &tracker.map.keyframes[newest];
        let sightings = Sightings::new(features, landmarks, &tracker.map, &tracker.rig);
        assert!(!sightings.seen.is_empty());
        for frame in 0..2 * MOST_WAITING {
            let (frame_index, camera_from_reference, sightings) = (1000 + frame, Se3::identity(), sightings.clone());
            tracker.records.push(Record { frame_index, timestamp_s: 0.1, reference: newest, camera_from_reference, sightings });
            tracker.settle_old_frames();
        }
        assert_eq!(tracker.records.len() - tracker.frames.settled, MOST_WAITING);
    }

    #[test]
    fn what_frames_saw_is_thinned_evenly_where_memory_is_short() {
        const FRAMES: usize = 100;
        let mut tracker = tracker(Sensor::Rgbd, &Sim3::identity());
        let Keyframe { features, landmarks, .. } = &tracker.map.keyframes[2];
        let sightings = Sightings::new(features, landmarks, &tracker.map, &tracker.rig);
        let bytes = sightings.bytes() as u64;
        tracker.rig.config.max_host_bytes = 30 * bytes * SHARE_OF_HOST_BYTES;
        let record = |frame| Record {
            frame_index: 1000 + frame,
            timestamp_s: 0.1,
            reference: 1,
            camera_from_reference: Se3::identity(),
            sightings: sightings.clone(),
        };
        tracker.records = (0..FRAMES).map(record).collect();
        tracker.settle_all_frames();
        let kept: Vec<usize> = (0..FRAMES).filter(|k| !tracker.records[*k].sightings.seen.is_empty()).collect();
        assert_eq!(kept, (0..FRAMES).step_by(4).collect::<Vec<_>>());
        assert_eq!(tracker.frame_bytes(), 25 * bytes);
        let views = tracker.frame_views(0, 10 * sightings.seen.len());
        assert_eq!(views.len(), 9, "every third: evenly, at most ten");
        // Solved again, they keep what they have.
        tracker.unsettle_frames();
        tracker.settle_all_frames();
        assert_eq!(tracker.frame_bytes(), 25 * bytes);
        // Without depth, they are of no use.
        tracker.sensor = Sensor::Mono;
        assert!(tracker.frame_views(0, usize::MAX).is_empty());
        tracker.unsettle_frames();
        tracker.settle_all_frames();
        assert_eq!(tracker.frame_bytes(), 0);
    }
}
