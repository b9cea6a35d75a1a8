//! Frames between keyframes: which of them become image-only keyframes, and their poses once the landmarks that they saw have settled.
//!
//! The tracker carries a frame by its reference keyframe. Bundle adjustment moves keyframe and landmarks in different ways; the pose is therefore
//! solved once more when it is over with both: at once for image-only keyframes and without measured depth, else when memory is short or at the end.
//! With measured depth, observations are kept as far as memory allows: the adjustment at the end includes them, and the poses are solved after it.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;

use super::sightings::Sightings;
use super::{Tracker, keyframe_selection};
use crate::geometry::Se3;
use crate::sequence::Sensor;
use crate::tracking::adjustment::local_bundle::FrameView;
use crate::tracking::map::sparse_map::{Keyframe, Map, SETTLED_AFTER};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::pose::optimise_pose;
use crate::tracking::{KeyframePose, NewKeyframe};

/// At each frame so many are, so that none takes long.
const SETTLED_A_FRAME: usize = 2;
/// Frames that may wait for it: a camera that stands still makes no keyframes.
const MOST_WAITING: usize = 256;
/// What frames saw takes at most this share of the tracker's host memory: one half for settled frames, one for those that wait.
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

/// What is kept of frames between keyframes.
#[derive(Debug, Default)]
pub(super) struct Frames {
    /// Bundle adjustment is over with the landmarks of records before this one.
    aged: usize,
    /// What those of them that are not settled saw, bytes.
    waiting_bytes: usize,
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

    /// Solves the poses of frames whose landmarks bundle adjustment has left behind and that cannot wait for the end, a few at a time.
    pub(super) fn settle_old_frames(&mut self) {
        let end = self.map.keyframes.len().saturating_sub(SETTLED_AFTER);
        let may_wait = self.adjusts_frames();
        for _ in 0..SETTLED_A_FRAME {
            let aged = self.frames.aged;
            let is_old = self.records.get(aged).is_some_and(|record| record.reference < end);
            if is_old || self.records.len() > aged + MOST_WAITING {
                self.frames.waiting_bytes += self.records[aged].sightings.bytes();
                if may_wait && self.is_image_only(aged) && self.records[aged].settle(&self.map, &self.rig) {
                    self.frames.moved.insert(aged);
                }
                self.frames.aged += 1;
            }
            let cannot_wait = !may_wait || self.frames.waiting_bytes > self.most_frame_bytes();
            if cannot_wait && self.frames.settled < self.frames.aged {
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
        self.frames.waiting_bytes +=
            self.records[self.frames.aged..].iter().map(|record| record.sightings.bytes()).sum::<usize>();
        self.frames.aged = self.records.len();
        moved.into_iter().for_each(|moved| self.note_settled(moved));
    }

    /// Frames between the keyframes of a submap, for bundle adjustment: evenly, with so many observations at most.
    pub(super) fn frame_views(&self, root: usize, most_observations: usize) -> Vec<FrameView> {
        if !self.adjusts_frames() {
            return Vec::new();
        }
        let of_submap = |record: &&Record| self.map.keyframes[record.reference].root == root && !record.sightings.seen.is_empty();
        // Those that wait are no denser than those that are settled.
        let records: Vec<&Record> = self.records.iter().step_by(1 << self.frames.halvings).filter(of_submap).collect();
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
        let frames = &mut self.frames;
        frames.waiting_bytes += std::mem::take(&mut frames.kept_bytes);
        frames.settled = 0;
    }

    /// Memory of what frames saw, bytes.
    pub(super) fn frame_bytes(&self) -> u64 {
        (self.frames.waiting_bytes + self.frames.kept_bytes) as u64
    }

    /// Bytes that settled frames may keep, and as many that frames may wait with.
    fn most_frame_bytes(&self) -> usize {
        (self.rig.config.max_host_bytes / SHARE_OF_HOST_BYTES / 2) as usize
    }

    /// Whether a record is that of an image-only keyframe.
    fn is_image_only(&self, record: usize) -> bool {
        self.frames.images_of(self.records[record].reference).binary_search(&record).is_ok()
    }

    /// A settled record keeps its sightings, or gives them up; where all together are too many, every other record does.
    fn keep_or_drop_sightings(&mut self, settled: usize) {
        let (most, kept) = (self.most_frame_bytes(), self.adjusts_frames());
        let frames = &mut self.frames;
        frames.waiting_bytes -= self.records[settled].sightings.bytes();
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
        if moved && self.is_image_only(settled) {
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
    use crate::tracking::solvers::relative_pose::RelativePose;
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
        assert_eq!(tracker.records.len() - tracker.frames.aged, MOST_WAITING);
    }

    #[test]
    fn frames_wait_for_the_end_unless_memory_is_short_or_the_mapper_has_them() {
        const IMAGE: usize = 5;
        let solved = |sensor, max_host_bytes| {
            let mut tracker = tracker(sensor, &Sim3::identity());
            tracker.rig.config.max_host_bytes = max_host_bytes;
            let Keyframe { features, landmarks, camera_from_world, .. } = tracker.map.keyframes[2].clone();
            let off = Se3::translation(0.01, 0.0, -0.01) * camera_from_world;
            let (camera_from_reference, sightings) =
                (tracker.map.keyframes[1].relative(&off), Sightings::new(&features, &landmarks, &tracker.map, &tracker.rig));
            let record = |k: usize| Record {
                frame_index: 1000 + k,
                timestamp_s: 0.1,
                reference: 1,
                camera_from_reference,
                sightings: sightings.clone(),
            };
            tracker.records = (0..20).map(record).collect();
            tracker.frames.images.insert(1, vec![IMAGE]);
            (0..20).for_each(|_| tracker.settle_old_frames());
            assert_eq!(tracker.frames.aged, 20);
            let is_solved = |tracker: &Tracker| {
                let poses = tracker.records.iter().map(|r| (r.pose(&tracker.map) * camera_from_world.inverse()).translation);
                poses.map(|off| off.vector.norm() < 0.002).collect::<Vec<bool>>()
            };
            let before = is_solved(&tracker);
            tracker.settle_all_frames();
            assert!(is_solved(&tracker).iter().all(|solved| *solved));
            assert!(tracker.frames.take_moved().contains(&IMAGE));
            let count = before.iter().filter(|solved| **solved).count();
            assert!(before[IMAGE]);
            count
        };
        assert_eq!(solved(Sensor::Rgbd, u64::MAX), 1);
        assert_eq!(solved(Sensor::Rgbd, 0), 20);
        assert_eq!(solved(Sensor::Mono, u64::MAX), 20);
    }

    #[test]
    fn what_frames_saw_is_thinned_evenly_where_memory_is_short() {
        const FRAMES: usize = 100;
        let mut tracker = tracker(Sensor::Rgbd, &Sim3::identity());
        let Keyframe { features, landmarks, .. } = &tracker.map.keyframes[2];
        let sightings = Sightings::new(features, landmarks, &tracker.map, &tracker.rig);
        let bytes = sightings.bytes() as u64;
        tracker.rig.config.max_host_bytes = 2 * 30 * bytes * SHARE_OF_HOST_BYTES;
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
