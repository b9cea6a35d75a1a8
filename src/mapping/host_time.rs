//! The mapping thread's own CPU time: what a GPU would wait for. Software adapters compute in other threads.

use std::collections::BTreeMap;
use std::time::Duration;

use cpu_time::ThreadTime;

/// CPU time of the thread by part of the mapper's work.
#[derive(Clone, Debug, Default)]
pub struct HostTimes(BTreeMap<&'static str, Duration>);

impl HostTimes {
    /// The parts, by name.
    pub fn parts(&self) -> impl Iterator<Item = (&'static str, Duration)> + '_ {
        self.0.iter().map(|(part, time)| (*part, *time))
    }

    /// Adds the time since `started`.
    pub(super) fn add(&mut self, part: &'static str, started: ThreadTime) {
        *self.0.entry(part).or_default() += started.elapsed();
    }
}
