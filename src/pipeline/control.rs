//! Switches of a run: pause, step, finish, refine on.

use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::time::{Duration, Instant};

/// How often a paused thread looks.
const LOOK_EVERY: Duration = Duration::from_millis(10);

const GOING: u8 = 0;
/// Pauses after the next keyframe or round of the refinement.
const STEPPING: u8 = 1;
const PAUSED: u8 = 2;

/// Switches of a run, for any thread to set.
#[derive(Debug, Default)]
pub struct Control {
    stopped: AtomicBool,
    interrupted: AtomicBool,
    leaving: AtomicBool,
    /// [`GOING`], [`STEPPING`] or [`PAUSED`].
    pace: AtomicU8,
    refining_on: AtomicBool,
    keeping: AtomicBool,
}

impl Control {
    /// Ends the run early; its partial result is returned.
    pub fn stop(&self) {
        self.refine_on(false);
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// Whether the run is to end early.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// Ends the run early, and whatever would follow it; returns whether that was done before.
    pub fn interrupt(&self) -> bool {
        self.stop();
        self.interrupted.swap(true, Ordering::Relaxed)
    }

    /// Whether the program is to end.
    pub fn is_interrupted(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed)
    }

    /// Ends the run after the next keyframe or round, with a checkpoint where it keeps checkpoints.
    pub fn leave(&self) {
        self.resume();
        self.refine_on(false);
        self.leaving.store(true, Ordering::Relaxed);
    }

    /// Whether the run is to end at its next checkpoint.
    pub fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Relaxed)
    }

    /// Takes a stop and a pause back, so that the refinement of a finished run can go on.
    pub fn restart(&self) {
        self.resume();
        self.stopped.store(self.is_interrupted(), Ordering::Relaxed);
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
        self.pace.store(PAUSED, Ordering::Relaxed);
    }

    /// Lets a paused run go on.
    pub fn resume(&self) {
        self.pace.store(GOING, Ordering::Relaxed);
    }

    /// Whether the run is held.
    pub fn is_paused(&self) -> bool {
        self.pace.load(Ordering::Relaxed) == PAUSED && !self.is_stopped()
    }

    /// Lets the run go on until the next keyframe is mapped, or the next round of the refinement is over.
    pub fn step(&self) {
        self.pace.store(STEPPING, Ordering::Relaxed);
    }

    /// Ends a step, after a keyframe or a round.
    pub(super) fn finished_one(&self) {
        // Whoever has let the run go on meanwhile prevails.
        let _ = self.pace.compare_exchange(STEPPING, PAUSED, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Goes on refining when the refinement is over, until the run is stopped or this is switched off.
    pub fn refine_on(&self, on: bool) {
        self.refining_on.store(on, Ordering::Relaxed);
    }

    /// Whether the refinement goes on beyond its end.
    pub fn refines_on(&self) -> bool {
        self.refining_on.load(Ordering::Relaxed)
    }

    /// Waits while the run is held, and does what comes `meanwhile`, whose error ends the wait; returns for how long it waited.
    pub(super) fn wait_while_paused<E>(&self, mut meanwhile: impl FnMut() -> Result<(), E>) -> Result<Duration, E> {
        if !self.is_paused() {
            return Ok(Duration::ZERO);
        }
        let began = Instant::now();
        while self.is_paused() {
            meanwhile()?;
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(began.elapsed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wait(control: &Control, looks: usize) -> usize {
        let mut seen = 0;
        let waited = control.wait_while_paused(|| {
            seen += 1;
            if seen == looks { Err(()) } else { Ok(()) }
        });
        assert_eq!(waited.is_err(), seen == looks && looks > 0);
        seen
    }

    #[test]
    fn a_step_ends_in_a_pause() {
        let control = Control::default();
        assert_eq!(wait(&control, 3), 0);
        control.pause();
        control.step();
        assert!(!control.is_paused());
        control.finished_one();
        assert!(control.is_paused());
        assert_eq!(wait(&control, 3), 3, "an error ends the wait");
        control.resume();
        control.finished_one();
        assert!(!control.is_paused());
    }

    #[test]
    fn a_run_that_ends_is_held_no_longer() {
        let control = Control::default();
        control.pause();
        control.refine_on(true);
        control.stop();
        assert!(control.is_stopped() && !control.is_paused() && !control.refines_on() && !control.is_interrupted());
        control.restart();
        assert!(!control.is_stopped() && !control.is_paused());
        assert!(!control.interrupt() && control.interrupt());
        control.restart();
        assert!(control.is_stopped(), "an interruption is not taken back");
    }
}
