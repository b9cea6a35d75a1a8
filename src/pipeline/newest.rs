//! The newest value of a kind: one thread replaces it whole, any number read it, nobody waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use arc_swap::ArcSwapOption;

/// The newest value of a kind. Costly ones are made only where somebody wants one.
#[derive(Debug)]
pub struct Newest<T> {
    value: ArcSwapOption<T>,
    wanted: AtomicBool,
}

impl<T> Default for Newest<T> {
    fn default() -> Self {
        Self { value: ArcSwapOption::empty(), wanted: AtomicBool::new(false) }
    }
}

impl<T> Newest<T> {
    /// The newest value, if there is one yet.
    pub fn get(&self) -> Option<Arc<T>> {
        self.value.load_full()
    }

    /// Requests a newer value.
    pub fn want(&self) {
        self.wanted.store(true, Ordering::Relaxed);
    }

    /// Whether a newer value is wanted.
    pub fn is_wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Replaces the value; the next one has to be requested again.
    pub fn put(&self, value: T) {
        self.wanted.store(false, Ordering::Relaxed);
        self.value.store(Some(Arc::new(value)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_answers_one_wish() {
        let newest = Newest::default();
        assert!(newest.get().is_none() && !newest.is_wanted());
        newest.want();
        assert!(newest.is_wanted());
        newest.put(3);
        newest.put(4);
        assert_eq!((newest.get().as_deref(), newest.is_wanted()), (Some(&4), false));
    }
}
