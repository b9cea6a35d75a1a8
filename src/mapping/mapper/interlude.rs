//! What others do with the mapper between two batches of its steps.

use std::ops::ControlFlow;

use super::Mapper;
use crate::mapping::MappingError;

/// Called between two batches of steps: renders or downloads the map, waits, or ends the steps early. A closure that returns whether to stop is one.
pub trait Interlude {
    /// `Break` ends the steps.
    ///
    /// # Errors
    /// [`MappingError`] if the device fails.
    fn between(&self, mapper: &Mapper) -> Result<ControlFlow<()>, MappingError>;
}

impl<Stop: Fn() -> bool> Interlude for Stop {
    fn between(&self, _: &Mapper) -> Result<ControlFlow<()>, MappingError> {
        Ok(if self() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}
