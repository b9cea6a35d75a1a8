//! The adapter with what runs on it, shared by all families.

use std::cell::RefCell;
use std::sync::Arc;

use crate::gpu::{Gpu, GpuError};
use crate::optimise::Trainer;
use crate::render::{BlendForm, GpuCloud};
use crate::splat::GaussianCloud;

/// A trainer of each form of the blending passes.
#[derive(Debug)]
pub struct Machine {
    /// The device under test.
    pub gpu: Arc<Gpu>,
    forms: [RefCell<Trainer>; 2],
}

impl Machine {
    /// On the adapter whose name contains `adapter`, or on the fastest.
    ///
    /// # Errors
    /// [`GpuError`] if there is none.
    pub fn open(adapter: Option<&str>) -> Result<Self, GpuError> {
        let gpu = Gpu::open(adapter)?;
        let form = |form| -> Result<_, GpuError> { Ok(RefCell::new(Trainer::with_form(gpu.clone(), form)?)) };
        let [first, second] = BlendForm::ALL;
        Ok(Self { forms: [form(first)?, form(second)?], gpu })
    }

    /// Runs on one of the two forms.
    pub(super) fn with<T>(&self, form: usize, work: impl FnOnce(&mut Trainer) -> T) -> T {
        work(&mut self.forms[form % 2].borrow_mut())
    }

    pub(super) fn upload(&self, cloud: &GaussianCloud) -> Result<GpuCloud, GpuError> {
        GpuCloud::of(&self.gpu, cloud)
    }
}
