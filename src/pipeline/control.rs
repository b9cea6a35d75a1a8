//! Switches of a run: pause, step, finish, refine on.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often a paused thread looks.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Switches of a run, for any thread to set.
#[derive(Debug, Default)]
pub struct Control {
    stopped: AtomicBool,
    paused: AtomicBool,
    /// Pause again after the next keyframe or round of the refinement.
    stepping: AtomicBool,
    refining_on: AtomicBool,
    keeping: AtomicBool,
}

impl Control {
    /// Ends the run early; its partial result is returned. Whether it had been ended before.
    pub fn stop(&self) -> bool {
        self.stopped.swap(true, Ordering::Relaxed)
    }

    /// Whether the run is to end early.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// Takes a stop back, so that the refinement of a finished run can go on.
    pub fn restart(&self) {
        self.stopped.store(false, Ordering::Relaxed);
    }

    /// Keeps the mapper beyond the run's end.
    pub fn keep_mapper(&self) {
        self.keeping.store(true, Ordering::Relaxed);
    }

    /// Whether the mapper is kept beyond the run's end.
    pub(super) fn keeps_mapper(&self) -> bool {
        self.keeping.load(Ordering::Relaxed)
    }

    /// Holds the run before its next frame and its next batch of steps.
    pub fn pause(&self) {
        self.paused.store(true, Ordering::Relaxed);
    }

    /// Lets a paused run go on.
    pub fn resume(&self) {
        self.stepping.store(false, Ordering::Relaxed);
        self.paused.store(false, Ordering::Relaxed);
    }

    /// Whether the run is held.
    pub fn is_paused(&self) -> bool {
        self.paused.load(Ordering::Relaxed) && !self.is_stopped()
    }

    /// Lets the run go on until the next keyframe is mapped, or the next round of the refinement is over.
    pub fn step(&self) {
        self.stepping.store(true, Ordering::Relaxed);
        self.paused.store(false, Ordering::Relaxed);
    }

    /// A keyframe or a round is over.
    pub(super) fn finished_one(&self) {
        if self.stepping.swap(false, Ordering::Relaxed) {
            self.pause();
        }
    }

    /// Goes on refining when the refinement is over, until the run is stopped or this is switched off.
    pub fn refine_on(&self, on: bool) {
        self.refining_on.store(on, Ordering::Relaxed);
    }

    /// Whether the refinement goes on beyond its end.
    pub fn refines_on(&self) -> bool {
        self.refining_on.load(Ordering::Relaxed)
    }

    /// Waits while the run is held, and does what comes meanwhile; returns for how long.
    pub(super) fn wait_while_paused(&self, mut meanwhile: impl FnMut()) -> Duration {
        if !self.is_paused() {
            return Duration::ZERO;
        }
        let began = Instant::now();
        while self.is_paused() {
            meanwhile();
            std::thread::sleep(LOOK_EVERY);
        }
        began.elapsed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_ends_in_a_pause() {
        let control = Control::default();
        assert_eq!(control.wait_while_paused(|| unreachable!()), Duration::ZERO);
        control.pause();
        control.step();
        assert!(!control.is_paused());
        control.finished_one();
        assert!(control.is_paused());
        let mut looks = 0;
        control.wait_while_paused(|| {
            looks += 1;
            if looks == 3 {
                control.resume();
            }
        });
        control.finished_one();
        assert!(looks == 3 && !control.is_paused());
        control.pause();
        assert!(!control.stop() && control.stop());
        assert!(control.is_stopped() && !control.is_paused(), "a run that ends is held no longer");
    }
}
