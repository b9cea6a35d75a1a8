//! The adapter with what runs on it, shared by all families.

use std::cell::RefCell;
use std::sync::Arc;

use crate::gpu::{Gpu, GpuError};
use crate::optimise::Trainer;
use crate::render::{BlendForm, Blending, GpuCloud};
use crate::splat::GaussianCloud;
use crate::splat::model::Surface;

/// A trainer of all blending passes.
#[derive(Debug)]
pub struct Machine {
    /// The device under test.
    pub gpu: Arc<Gpu>,
    trainers: Vec<RefCell<Trainer>>,
}

impl Machine {
    /// On the adapter whose name contains `adapter`, or on the fastest.
    ///
    /// # Errors
    /// [`GpuError`] if there is none.
    pub fn open(adapter: Option<&str>) -> Result<Self, GpuError> {
        let gpu = Gpu::open(adapter)?;
        let trainer = |blending| Ok(RefCell::new(Trainer::with_blending(gpu.clone(), blending)?));
        Ok(Self { trainers: Blending::all().map(trainer).collect::<Result<_, GpuError>>()?, gpu })
    }

    /// Runs on one of the two forms.
    pub(super) fn with<T>(&self, form: usize, work: impl FnOnce(&mut Trainer) -> T) -> T {
        self.with_surface(form, Surface::Volume, work)
    }

    /// The same of a surface.
    pub(super) fn with_surface<T>(&self, form: usize, surface: Surface, work: impl FnOnce(&mut Trainer) -> T) -> T {
        let blending = Blending { form: BlendForm::ALL[form % 2], surface };
        let place = Blending::all().position(|other| other == blending).expect("all of them are there");
        work(&mut self.trainers[place].borrow_mut())
    }

    pub(super) fn upload(&self, cloud: &GaussianCloud) -> Result<GpuCloud, GpuError> {
        GpuCloud::of(&self.gpu, cloud)
    }
}
