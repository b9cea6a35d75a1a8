//! Bundle adjustment beside tracking: when it begins, when its result is taken into the map, and what follows then: the search for a
//! loop, and the culling of keyframes.
//!
//! One adjustment is under way at a time, and everything that changes the map happens here, in the tracking thread. In deterministic replay a result is
//! taken in at a fixed frame, or before the next keyframe is made, so that replay is bit-reproducible. In real time it is taken in when it is
//! ready, and keyframes that come meanwhile wait for the next adjustment, which takes them along.

use std::time::Instant;

use super::{Record, Tracker, milliseconds};
use crate::geometry::Se3;
use crate::sequence::Sensor;
use crate::tracking::adjustment::local_bundle::Adjustment;
use crate::tracking::allocator;
use crate::tracking::map::keyframe_culling::{cull_around, thin};
use crate::tracking::rig::Rig;
use crate::tracking::solvers::depth_bias::BiasPrior;
use crate::tracking::worker::Worker;
use crate::tracking::{KeyframeUpdate, StageTimes, TrackingError};

/// Deterministic replay: frames after its keyframe at which an adjustment is taken in, at most, and as a share of those since the keyframe before:
/// where keyframes follow each other closely the map must not lag behind. Points that were only triangulated are poor until they are
/// adjusted: without depth it is always the next frame.
const TAKEN_IN_AFTER: usize = 3;
const TAKEN_IN_SHARE: usize = 4;
/// Observations up to which the whole submap is adjusted at the end, when no frame waits, and what each takes of host memory.
const MOST_AT_THE_END: usize = 2_000_000;
const BYTES_PER_OBSERVATION: u64 = 450;
/// Observations of frames between keyframes in that adjustment, at most; more if the keyframes have more.
const MOST_OF_FRAMES: usize = 150_000;
/// Keyframes that thinning culls until freed memory goes back to the system.
const GIVEN_BACK_EVERY: usize = 256;

/// The worker, and what it is at.
#[derive(Debug)]
pub(super) struct Adjusting {
    worker: Worker<Adjustment>,
    pub real_time: bool,
    under_way: Option<UnderWay>,
    /// The frame, counted from 1, at which the newest keyframe was made, and frames since the one before.
    newest_at: usize,
    interval: usize,
    /// The newest keyframe, if its surroundings are still to be adjusted.
    waiting: Option<Waiting>,
    /// Real time: keyframes that came before it and are still to be searched for loops.
    overtaken: Vec<usize>,
    /// Where thinning goes on, and how many keyframes it has culled since freed memory went back to the system.
    thinned: usize,
    freed: usize,
    /// Frames seen when the whole map was adjusted last.
    all_adjusted_at: usize,
}

#[derive(Clone, Copy, Debug)]
struct UnderWay {
    /// The keyframe whose surroundings it adjusts.
    around: usize,
    /// Deterministic replay: the frame, counted from 1, at which it is taken in.
    due: usize,
}

#[derive(Clone, Copy, Debug)]
struct Waiting {
    keyframe: usize,
    /// Whether landmarks or relative poses hold it.
    held: bool,
}

impl Adjusting {
    pub fn new(worker: Worker<Adjustment>) -> Self {
        Self {
            worker,
            real_time: false,
            newest_at: 0,
            interval: 0,
            under_way: None,
            waiting: None,
            overtaken: Vec::new(),
            thinned: 0,
            freed: 0,
            all_adjusted_at: 0,
        }
    }
}

impl Tracker {
    /// To be called when no frame is left: waits for all that is under way, takes it in, and adjusts the trajectory's submap as a whole. Returns
    /// the keyframes that moved since the last frame.
    ///
    /// # Errors
    /// [`TrackingError::Adjusting`] if the adjustment panicked.
    pub fn finish(&mut self) -> Result<Vec<KeyframeUpdate>, TrackingError> {
        self.take_in_all()?;
        self.adjust_all();
        self.settle_all_frames();
        Ok(self.updates())
    }

    /// As [`Self::finish`] without the last adjustment: after an error.
    ///
    /// # Errors
    /// Those of [`Self::finish`].
    pub fn break_off(&mut self) -> Result<Vec<KeyframeUpdate>, TrackingError> {
        self.take_in_all()?;
        self.settle_all_frames();
        Ok(self.updates())
    }

    fn take_in_all(&mut self) -> Result<(), TrackingError> {
        loop {
            self.take_all_adjusted(&mut StageTimes::default())?;
            if !self.wait_for_closing()? && self.adjusting.under_way.is_none() {
                return Ok(());
            }
        }
    }

    /// Adjusts the whole submap of the trajectory once more, unless it is too large: what each window found reaches all others.
    fn adjust_all(&mut self) {
        if std::mem::replace(&mut self.adjusting.all_adjusted_at, self.frames_seen) == self.frames_seen {
            return;
        }
        let most = MOST_AT_THE_END.min((self.rig.config.max_host_bytes / BYTES_PER_OBSERVATION) as usize);
        let root = self.largest_submap();
        let Some(all) = Adjustment::of_all(&self.map, root, most, &self.rig) else { return };
        let of_keyframes = all.problem.observations.len();
        let frames = self.frame_views(root, most.saturating_sub(of_keyframes).min(of_keyframes.max(MOST_OF_FRAMES)));
        let mut all = self.with_bias(all).with_frames(&frames);
        all.solve(&self.rig.pinhole, self.rig.config.bundle_iterations);
        self.rig.depth_bias = all.bias().unwrap_or(self.rig.depth_bias);
        all.apply(&mut self.map, &self.rig.config).into_iter().for_each(|k| self.note_move(k, 1.0));
        self.follow_keyframe();
        self.unsettle_frames();
    }

    /// Has the surroundings of a new keyframe adjusted, now or when the worker is free.
    pub(super) fn adjust_around(&mut self, keyframe: usize, held: bool, times: &mut StageTimes) -> Result<(), TrackingError> {
        self.adjusting.interval = self.frames_seen - self.adjusting.newest_at;
        self.adjusting.newest_at = self.frames_seen;
        let overtaken = self.adjusting.waiting.replace(Waiting { keyframe, held });
        self.adjusting.overtaken.extend(overtaken.map(|waiting| waiting.keyframe));
        self.begin_next(times)
    }

    /// Takes in what has been adjusted, if it is time for it; `false` if it is not.
    pub(super) fn take_adjusted(&mut self, times: &mut StageTimes) -> Result<bool, TrackingError> {
        let Some(under_way) = self.adjusting.under_way else { return Ok(false) };
        if self.adjusting.real_time {
            let Some(solved) = self.adjusting.worker.poll()? else { return Ok(false) };
            self.take_in(under_way, &solved, times)?;
        } else if self.frames_seen >= under_way.due {
            self.wait_for(under_way, times)?;
        } else {
            return Ok(false);
        }
        Ok(true)
    }

    /// Takes in all that is under way, and what follows from it.
    pub(super) fn take_all_adjusted(&mut self, times: &mut StageTimes) -> Result<(), TrackingError> {
        while let Some(under_way) = self.adjusting.under_way {
            self.wait_for(under_way, times)?;
        }
        Ok(())
    }

    /// Before a keyframe is created: deterministic replay waits for the previous adjustment, real time never.
    pub(super) fn finish_adjustment_before_keyframe(&mut self, times: &mut StageTimes) -> Result<(), TrackingError> {
        if self.adjusting.real_time { Ok(()) } else { self.take_all_adjusted(times) }
    }

    fn wait_for(&mut self, under_way: UnderWay, times: &mut StageTimes) -> Result<(), TrackingError> {
        let clock = Instant::now();
        let solved = self.adjusting.worker.wait()?;
        times.bundle_ms += milliseconds(clock);
        self.take_in(under_way, &solved, times)
    }

    fn take_in(&mut self, under_way: UnderWay, solved: &Adjustment, times: &mut StageTimes) -> Result<(), TrackingError> {
        let clock = Instant::now();
        self.adjusting.under_way = None;
        if !solved.fits(&self.map) {
            // A correction came between: once more, unless a newer keyframe's window is next.
            match self.adjusting.waiting {
                Some(_) => self.adjusting.overtaken.push(under_way.around),
                None => self.adjusting.waiting = Some(Waiting { keyframe: under_way.around, held: true }),
            }
            return self.begin_next(times);
        }
        solved.apply(&mut self.map, &self.rig.config).into_iter().for_each(|k| self.note_move(k, 1.0));
        self.rig.depth_bias = solved.bias().unwrap_or(self.rig.depth_bias);
        times.bundle_ms += milliseconds(clock);
        self.close_loops_and_cull(under_way.around, times);
        self.follow_keyframe();
        self.begin_next(times)
    }

    /// Begins the next adjustment if none is under way.
    fn begin_next(&mut self, times: &mut StageTimes) -> Result<(), TrackingError> {
        if self.adjusting.under_way.is_some() {
            return Ok(());
        }
        let Some(Waiting { keyframe, held }) = self.adjusting.waiting.take() else { return Ok(()) };
        let clock = Instant::now();
        // A keyframe that few landmarks hold would be torn from where its pixels put it.
        let window = held.then(|| Adjustment::of_window(&self.map, keyframe, &self.rig)).flatten();
        let window = window.map(|window| self.with_bias(window));
        times.bundle_ms += milliseconds(clock);
        if let Some(window) = window {
            return self.begin(window, keyframe);
        }
        self.close_loops_and_cull(keyframe, times);
        Ok(())
    }

    /// An adjustment with the bias among its unknowns, where it is estimated.
    fn with_bias(&self, adjustment: Adjustment) -> Adjustment {
        if !self.seeks_bias() {
            return adjustment;
        }
        let Rig { pinhole, config, depth_bias, .. } = &self.rig;
        adjustment.with_bias(match self.sensor {
            Sensor::Stereo { baseline_metres } => BiasPrior::of_pair(pinhole.fx * baseline_metres),
            _ => BiasPrior::after(depth_bias, config.inverse_depth_sigma),
        })
    }

    /// Whether the bias of depth is estimated.
    pub(super) fn seeks_bias(&self) -> bool {
        self.rig.config.depth_bias && self.sensor != Sensor::Mono
    }

    fn begin(&mut self, adjustment: Adjustment, around: usize) -> Result<(), TrackingError> {
        self.adjusting.worker.give(adjustment)?;
        let most = if self.sensor == Sensor::Mono { 1 } else { TAKEN_IN_AFTER };
        let later = (self.adjusting.interval / TAKEN_IN_SHARE).clamp(1, most);
        self.adjusting.under_way = Some(UnderWay { around, due: self.frames_seen + later });
        Ok(())
    }

    /// Runs after a keyframe's local bundle adjustment: a loop may be found, at it or at keyframes that it has overtaken, or some keyframes may
    /// have become redundant.
    fn close_loops_and_cull(&mut self, keyframe: usize, times: &mut StageTimes) {
        let mut closed = false;
        let mut keyframes = std::mem::take(&mut self.adjusting.overtaken);
        keyframes.push(keyframe);
        keyframes.iter().for_each(|keyframe| self.refresh_links(*keyframe));
        for keyframe in &keyframes {
            closed = closed || self.look_for_loop(*keyframe, times);
        }
        let clock = Instant::now();
        if !closed && self.rig.config.keyframe_culling {
            cull_around(&mut self.map, keyframe, |k| self.loops.holds(k), &self.rig.config);
        }
        let living = self.map.living.len();
        // One more than there are new ones, so that the map gets below its bound.
        for _ in 0..=keyframes.len() {
            let most = self.rig.config.max_host_bytes.saturating_sub(self.frame_bytes());
            self.adjusting.thinned = thin(&mut self.map, most, self.adjusting.thinned, |k| self.loops.holds(k), &self.rig.config);
        }
        self.adjusting.freed += living - self.map.living.len();
        if self.adjusting.freed >= GIVEN_BACK_EVERY {
            self.adjusting.freed = 0;
            allocator::give_back_freed();
        }
        self.motion.reference = self.map.living(self.motion.reference);
        times.mapping_ms += milliseconds(clock);
    }

    /// Bundle adjustment and joined landmarks have changed what a keyframe and its neighbours share.
    fn refresh_links(&mut self, keyframe: usize) {
        self.map.refresh_links(keyframe);
        let neighbours: Vec<usize> = self.map.keyframes[keyframe].links.iter().map(|(k, _)| *k).collect();
        neighbours.into_iter().for_each(|k| self.map.refresh_links(k));
    }

    /// The last frame goes with the keyframe that holds it, and forgets landmarks that are no more.
    pub(super) fn follow_keyframe(&mut self) {
        let (Some(last), Some(record)) = (&mut self.motion.last, self.records.last()) else { return };
        let keyframe = &self.map.keyframes[record.reference];
        last.camera_from_world = keyframe.carry(&record.camera_from_reference);
        if record.frame_index == keyframe.frame_index {
            last.landmarks.clone_from(&keyframe.landmarks);
        } else {
            last.landmarks.iter_mut().for_each(|l| *l = l.and_then(|l| self.map.resolve(l)));
        }
    }

    /// A keyframe moved, and lengths around it grew by a factor.
    pub(super) fn note_move(&mut self, keyframe: usize, growth: f64) {
        self.moved.push((keyframe, growth));
    }

    /// Keyframes that moved since the last call.
    pub(super) fn updates(&mut self) -> Vec<KeyframeUpdate> {
        let (mut moved, images) = (std::mem::take(&mut self.moved), self.frames.take_moved());
        moved.sort_by_key(|(keyframe, _)| *keyframe);
        moved.dedup_by(|again, first| {
            let twice = again.0 == first.0;
            if twice {
                first.1 *= again.1;
            }
            twice
        });
        let update =
            |id, camera_from_world: Se3, scale| KeyframeUpdate { id, world_from_camera: camera_from_world.inverse(), scale };
        let of_image = |record: &Record, scale| update(record.frame_index, record.pose(&self.map), scale);
        let mut updates = Vec::with_capacity(moved.len());
        for (k, scale) in &moved {
            let keyframe = &self.map.keyframes[*k];
            updates.push(update(keyframe.frame_index, keyframe.camera_from_world, *scale));
            updates.extend(self.frames.images_of(*k).iter().map(|record| of_image(&self.records[*record], *scale)));
        }
        let alone = images
            .iter()
            .map(|record| &self.records[*record])
            .filter(|record| moved.binary_search_by_key(&record.reference, |m| m.0).is_err());
        updates.extend(alone.map(|record| of_image(record, 1.0)));
        updates.sort_by_key(|update| update.id);
        updates
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::geometry::sim3::{self, Vector7};
    use crate::geometry::{Camera, Distortion, Sim3, se3};
    use crate::tracking::TrackingConfig;
    use crate::tracking::loop_closing::tests::drifted;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use nalgebra::Vector6;

    /// A tracker whose map drifts by a step from keyframe to keyframe.
    pub fn tracker(sensor: Sensor, step: &Sim3) -> Tracker {
        let config = TrackingConfig::default();
        let camera = Camera { pinhole: PINHOLE, distortion: Distortion::default(), depth_units_per_metre: 5000.0 };
        let map = drifted(step, sensor != Sensor::Mono, &config);
        Tracker { map, ..Tracker::new(camera, sensor, &config).unwrap() }
    }

    #[test]
    fn the_end_adjusts_all_keyframes_together() {
        let mut tracker = tracker(Sensor::Rgbd, &Sim3::identity());
        tracker.frames_seen = 1;
        let truth: Vec<Se3> = tracker.map.keyframes.iter().map(|k| k.camera_from_world).collect();
        for (k, pose) in truth.iter().enumerate().skip(1) {
            let side = if k % 2 == 0 { 1.0 } else { -1.0 };
            tracker.map.set_pose(k, se3::exp(&(Vector6::new(0.01, -0.005, 0.01, 0.003, 0.002, -0.004) * side)) * pose);
        }
        let worst = |tracker: &Tracker| {
            let off =
                tracker.map.keyframes.iter().zip(&truth).map(|(k, t)| se3::log(&(k.camera_from_world * t.inverse())).norm());
            off.fold(0.0, f64::max)
        };
        let before = worst(&tracker);
        let updates = tracker.finish().unwrap();
        assert!(worst(&tracker) < 0.2 * before, "{before} {}", worst(&tracker));
        assert_eq!(updates.len(), truth.len() - 1);
        assert!(tracker.finish().unwrap().is_empty());
    }

    #[test]
    fn the_scale_of_a_loop_without_depth_goes_out_with_the_poses() {
        let step = sim3::exp(&Vector7::from_column_slice(&[0.004, 0.001, -0.003, 0.001, 0.003, 0.0005, 0.004]));
        let mut tracker = tracker(Sensor::Mono, &step);
        let newest = tracker.map.keyframes.len() - 1;
        // Landmarks of each keyframe that it saw first, and their depths, metres.
        let depths = |tracker: &Tracker| -> Vec<Vec<(usize, f64)>> {
            let depth = |k: usize, l: usize| (tracker.map.keyframes[k].camera_from_world * tracker.map.position(l)).z;
            let own = |k: &usize, l: &usize| tracker.map.landmarks[*l].observations.first().is_some_and(|o| o.keyframe == *k);
            let seen = |k: usize| tracker.map.keyframes[k].landmarks.iter().flatten().copied().filter(move |l| own(&k, l));
            (0..=newest).map(|k| seen(k).map(|l| (l, depth(k, l))).collect()).collect()
        };
        let before = depths(&tracker);
        assert!(tracker.look_for_loop(newest, &mut StageTimes::default()));
        assert!(tracker.wait_for_closing().unwrap());
        tracker.note_move(3, 2.0);
        let after = depths(&tracker);
        let updates = tracker.updates();
        assert_eq!(updates.iter().map(|u| u.id).collect::<Vec<_>>(), (1..=newest).collect::<Vec<_>>());
        assert!(tracker.updates().is_empty());
        // Lengths had shrunk to 1/1.21 since the place was first seen, a round before.
        assert!((1.1..1.3).contains(&updates[newest - 1].scale), "{}", updates[newest - 1].scale);
        for KeyframeUpdate { id, world_from_camera, scale } in updates {
            assert_eq!(world_from_camera, tracker.map.keyframes[id].camera_from_world.inverse());
            let scale = if id == 3 { scale / 2.0 } else { scale };
            let landmarks = before[id].iter().filter_map(|(l, z)| Some(after[id].iter().find(|a| a.0 == *l)?.1 / z));
            let mut growths: Vec<f64> = landmarks.collect();
            growths.sort_by(f64::total_cmp);
            if let Some(median) = growths.get(growths.len() / 2) {
                assert!((median / scale - 1.0).abs() < 1e-6, "keyframe {id}: {scale}, landmarks {median}");
            }
        }
    }
}
