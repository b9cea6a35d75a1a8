//! The thread that solves bundle adjustments beside tracking. One at a time goes in, and comes out solved.

use std::thread::{Builder, JoinHandle};

use crossbeam::channel::{Receiver, Sender, TryRecvError, bounded};

use crate::geometry::Pinhole;
use crate::tracking::TrackingError;
use crate::tracking::adjustment::local_bundle::Adjustment;

/// The thread and the two ends of its channels. It ends with this.
#[derive(Debug)]
pub struct Worker {
    /// `None` only while it is dropped.
    jobs: Option<Sender<Adjustment>>,
    solved: Receiver<Adjustment>,
    thread: Option<JoinHandle<()>>,
}

impl Worker {
    /// `steps` as in [`Adjustment::solve`].
    ///
    /// # Errors
    /// [`TrackingError::Spawn`] if the system gives no thread.
    pub fn start(pinhole: Pinhole, steps: usize) -> Result<Self, TrackingError> {
        let (jobs, inbox) = bounded::<Adjustment>(1);
        let (outbox, solved) = bounded(1);
        let work = move || {
            for mut job in inbox {
                job.solve(&pinhole, steps);
                if outbox.send(job).is_err() {
                    break;
                }
            }
        };
        let thread = Builder::new().name("adjusting".into()).spawn(work).map_err(TrackingError::Spawn)?;
        Ok(Self { jobs: Some(jobs), solved, thread: Some(thread) })
    }

    /// Hands an adjustment over; the one before must have been taken out.
    ///
    /// # Errors
    /// As [`Self::wait`].
    pub fn give(&self, job: Adjustment) -> Result<(), TrackingError> {
        let jobs = self.jobs.as_ref().ok_or(TrackingError::Adjusting)?;
        jobs.try_send(job).map_err(|_| TrackingError::Adjusting)
    }

    /// Waits for the adjustment that was handed over.
    ///
    /// # Errors
    /// [`TrackingError::Adjusting`] if the thread has panicked.
    pub fn wait(&self) -> Result<Adjustment, TrackingError> {
        self.solved.recv().map_err(|_| TrackingError::Adjusting)
    }

    /// The adjustment if it is ready.
    ///
    /// # Errors
    /// As [`Self::wait`].
    pub fn poll(&self) -> Result<Option<Adjustment>, TrackingError> {
        match self.solved.try_recv() {
            Ok(done) => Ok(Some(done)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(TrackingError::Adjusting),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            // A panic was reported when its result was due.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::solvers::bundle::BundleObservation;
    use crate::tracking::solvers::residual::tests::PINHOLE;
    use crate::tracking::solvers::residual::{InlierClass, Measurement};

    #[test]
    fn a_panic_in_the_thread_is_an_error_and_no_hang() {
        let worker = Worker::start(PINHOLE, 3).unwrap();
        worker.give(Adjustment::default()).unwrap();
        assert!(worker.wait().unwrap().problem.poses.is_empty());
        let measurement =
            Measurement { pixel: nalgebra::Vector2::zeros(), inverse_depth: None, pixel_weight: 1.0, depth_weight: 1.0 };
        let mut broken = Adjustment::default();
        broken.problem.observations.push(BundleObservation { pose: 7, point: 7, measurement, class: InlierClass::PixelOnly });
        worker.give(broken).unwrap();
        assert!(matches!(worker.wait(), Err(TrackingError::Adjusting)));
        assert!(matches!(worker.poll(), Err(TrackingError::Adjusting)));
        assert!(matches!(worker.give(Adjustment::default()), Err(TrackingError::Adjusting)));
    }
}
