//! A thread that solves beside tracking. One job at a time goes in, and comes out solved.

use std::thread::{Builder, JoinHandle};

use crossbeam::channel::{Receiver, Sender, TryRecvError, bounded};

use crate::tracking::TrackingError;

/// The thread and the two ends of its channels. It ends with this.
#[derive(Debug)]
pub struct Worker<J> {
    /// `None` only while it is dropped.
    jobs: Option<Sender<J>>,
    solved: Receiver<J>,
    thread: Option<JoinHandle<()>>,
}

impl<J: Send + 'static> Worker<J> {
    /// A thread that works on each job with `solve`.
    ///
    /// # Errors
    /// [`TrackingError::Spawn`] if the system gives no thread.
    pub fn start(name: &str, solve: impl Fn(&mut J) + Send + 'static) -> Result<Self, TrackingError> {
        let (jobs, inbox) = bounded::<J>(1);
        let (outbox, solved) = bounded(1);
        let work = move || {
            for mut job in inbox {
                solve(&mut job);
                if outbox.send(job).is_err() {
                    break;
                }
            }
        };
        let thread = Builder::new().name(name.into()).spawn(work).map_err(TrackingError::Spawn)?;
        Ok(Self { jobs: Some(jobs), solved, thread: Some(thread) })
    }

    /// Hands a job over; the one before must have been taken out.
    ///
    /// # Errors
    /// As [`Self::wait`].
    pub fn give(&self, job: J) -> Result<(), TrackingError> {
        let jobs = self.jobs.as_ref().ok_or(TrackingError::Adjusting)?;
        jobs.try_send(job).map_err(|_| TrackingError::Adjusting)
    }

    /// Waits for the job that was handed over.
    ///
    /// # Errors
    /// [`TrackingError::Adjusting`] if the thread has panicked.
    pub fn wait(&self) -> Result<J, TrackingError> {
        self.solved.recv().map_err(|_| TrackingError::Adjusting)
    }

    /// The job if it is done.
    ///
    /// # Errors
    /// As [`Self::wait`].
    pub fn poll(&self) -> Result<Option<J>, TrackingError> {
        match self.solved.try_recv() {
            Ok(done) => Ok(Some(done)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(TrackingError::Adjusting),
        }
    }
}

impl<J> Drop for Worker<J> {
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

    #[test]
    fn a_panic_in_the_thread_is_an_error_and_no_hang() {
        let worker = Worker::start("halving", |number: &mut u32| *number = 10 / *number).unwrap();
        worker.give(5).unwrap();
        assert_eq!(worker.wait().unwrap(), 2);
        worker.give(0).unwrap();
        assert!(matches!(worker.wait(), Err(TrackingError::Adjusting)));
        assert!(matches!(worker.poll(), Err(TrackingError::Adjusting)));
        assert!(matches!(worker.give(1), Err(TrackingError::Adjusting)));
    }
}
