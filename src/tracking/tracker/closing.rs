//! Loops beside tracking: a correction is solved in a thread of its own, taken into the map when it is ready, and followed by bundle adjustment of
//! all that it moved: at once where that is little, else window by window.
//!
//! As with bundle adjustment, deterministic replay takes a result in at a fixed frame, the later the larger it is, and real time when it is ready.
//! What follows from a loop or a result begins a frame later, and in deterministic replay a frame after a bundle adjustment that is taken in.

use std::collections::VecDeque;
use std::time::Instant;

use super::{Tracker, milliseconds};
use crate::geometry::Pinhole;
use crate::tracking::adjustment::local_bundle::Adjustment;
use crate::tracking::loop_closing::{Correction, MovedKeyframe};
use crate::tracking::worker::Worker;
use crate::tracking::{StageTimes, TrackingError};

/// Deterministic replay: keyframes of a correction, and observations of an adjustment, that the thread has to itself a frame for.
const KEYFRAMES_A_FRAME: usize = 8;
const OBSERVATIONS_A_FRAME: usize = 500;
/// Observations up to which a loop is followed by one adjustment of its whole submap: bounds the time of making it and of taking it in.
const MOST_AT_A_LOOP: usize = 100_000;
/// Of the keyframes that a correction has moved, every so many gets a window of its own.
const WINDOW_EVERY: usize = 4;

/// The worker, and what it is at.
#[derive(Debug)]
pub(super) struct Closing {
    worker: Worker<Job>,
    /// Deterministic replay: the frame, counted from 1, at which the job under way is taken in.
    due: Option<usize>,
    /// Without a job: the frame, counted from 1, at which the next is made.
    next: usize,
    /// A correction is under way, or waits for the worker.
    correcting: bool,
    waiting: Option<Correction>,
    /// Keyframes whose windows are still to be adjusted.
    unsettled: VecDeque<usize>,
    /// Whether they may still be adjusted all at once. A large map takes long to rule it out, so it is tried once.
    all_at_once: bool,
}

#[derive(Debug)]
enum Job {
    Correct(Correction),
    /// Of all keyframes, or of a window.
    Adjust(Adjustment, Extent),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Extent {
    All,
    Window,
}

impl Closing {
    pub fn start(pinhole: Pinhole, steps: usize) -> Result<Self, TrackingError> {
        let solve = move |job: &mut Job| match job {
            Job::Correct(correction) => correction.solve(),
            Job::Adjust(adjustment, _) => adjustment.solve(&pinhole, steps),
        };
        let worker = Worker::start("closing", solve)?;
        Ok(Self { worker, due: None, next: 0, correcting: false, waiting: None, unsettled: VecDeque::new(), all_at_once: false })
    }
}

impl Tracker {
    /// Looks for a loop at a keyframe; `false` if there was none. One of two submaps joins them at once, any other is corrected beside tracking.
    pub(super) fn look_for_loop(&mut self, keyframe: usize, times: &mut StageTimes) -> bool {
        if !self.rig.config.loop_closing || self.closing.correcting {
            return false;
        }
        let clock = Instant::now();
        let recognised = self.loops.recognise(&mut self.map, keyframe, &self.rig);
        let found = recognised.is_some();
        if found {
            self.closing.next = self.frames_seen + 1;
        }
        match recognised {
            Some(correction) if correction.is_solved() => self.take_correction(&correction),
            Some(correction) => {
                self.closing.correcting = true;
                self.closing.waiting = Some(correction);
            }
            None => {}
        }
        times.loops_ms += milliseconds(clock);
        found
    }

    /// Takes in what the thread has solved, or gives it the next job, if it is time for it. `adjusted`: a bundle adjustment was taken in at
    /// this frame.
    pub(super) fn take_closed(&mut self, adjusted: bool, times: &mut StageTimes) -> Result<(), TrackingError> {
        let clock = Instant::now();
        let now = self.frames_seen - usize::from(adjusted);
        let solved = match self.closing.due {
            None if now >= self.closing.next => return self.begin_next_closing(times),
            Some(_) if self.adjusting.real_time => self.closing.worker.poll()?,
            Some(due) if now >= due => Some(self.closing.worker.wait()?),
            _ => None,
        };
        solved.into_iter().for_each(|job| self.take_job(job));
        times.loops_ms += milliseconds(clock);
        Ok(())
    }

    /// Waits for the job under way, or the next; `false` if there is none.
    pub(super) fn wait_for_closing(&mut self) -> Result<bool, TrackingError> {
        self.begin_next_closing(&mut StageTimes::default())?;
        if self.closing.due.is_none() {
            return Ok(false);
        }
        let job = self.closing.worker.wait()?;
        self.take_job(job);
        Ok(true)
    }

    fn take_job(&mut self, job: Job) {
        self.closing.due = None;
        self.closing.next = self.frames_seen + 1;
        match job {
            Job::Correct(correction) => {
                self.closing.correcting = false;
                self.take_correction(&correction);
            }
            Job::Adjust(adjustment, extent) if adjustment.fits(&self.map) => {
                adjustment.apply(&mut self.map, &self.rig.config).into_iter().for_each(|k| self.note_move(k, 1.0));
                // Windows that were being adjusted meanwhile do not fit any more.
                self.map.corrections += usize::from(extent == Extent::All);
                self.follow_keyframe();
            }
            Job::Adjust(..) => {}
        }
    }

    fn take_correction(&mut self, correction: &Correction) {
        let moved = self.loops.apply(correction, &mut self.map, &self.rig);
        for MovedKeyframe { keyframe, growth } in &moved {
            if *keyframe == self.motion.reference
                && let Some(velocity) = &mut self.motion.velocity
            {
                velocity.motion.translation.vector *= *growth;
            }
            self.note_move(*keyframe, *growth);
        }
        self.follow_keyframe();
        let living = moved.iter().map(|m| m.keyframe).filter(|k| !self.map.is_culled(*k));
        self.closing.unsettled = living.step_by(WINDOW_EVERY).collect();
        self.closing.all_at_once = true;
    }

    /// Gives the thread its next job: a correction, or bundle adjustment of what the last one moved.
    fn begin_next_closing(&mut self, times: &mut StageTimes) -> Result<(), TrackingError> {
        let clock = Instant::now();
        let next = if self.closing.due.is_none() { self.next_closing() } else { None };
        if let Some((job, later)) = next {
            self.closing.worker.give(job)?;
            self.closing.due = Some(self.frames_seen + later);
        }
        times.loops_ms += milliseconds(clock);
        Ok(())
    }

    /// The next job, and how many frames the thread has for it.
    fn next_closing(&mut self) -> Option<(Job, usize)> {
        if let Some(correction) = self.closing.waiting.take() {
            self.closing.unsettled.clear();
            let later = 1 + correction.size() / KEYFRAMES_A_FRAME;
            return Some((Job::Correct(correction), later));
        }
        let first = self.closing.unsettled.front().copied()?;
        let root = self.map.keyframes[first].root;
        if std::mem::take(&mut self.closing.all_at_once)
            && let Some(all) = Adjustment::of_all(&self.map, root, MOST_AT_A_LOOP, &self.rig)
        {
            self.closing.unsettled.clear();
            let later = 1 + all.problem.observations.len() / OBSERVATIONS_A_FRAME;
            return Some((Job::Adjust(all, Extent::All), later));
        }
        while let Some(keyframe) = self.closing.unsettled.pop_front() {
            let lives = !self.map.is_culled(keyframe);
            let window = lives.then(|| Adjustment::of_window(&self.map, keyframe, &self.rig)).flatten();
            if let Some(window) = window {
                let later = 1 + window.problem.observations.len() / OBSERVATIONS_A_FRAME;
                return Some((Job::Adjust(window, Extent::Window), later));
            }
        }
        None
    }
}
