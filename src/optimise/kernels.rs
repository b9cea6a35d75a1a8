//! The compiled passes of a training step after the forward rendering.

use crate::gpu::Kernel;
use crate::render::{BlendForm, Rasterizer, shaders};

#[derive(Debug)]
pub(super) struct Kernels {
    pub loss_forward: Kernel,
    pub loss_reduce: Kernel,
    pub loss_backward: Kernel,
    /// Only of a planar surface.
    pub surface_loss: Option<Kernel>,
    pub rasterize_backward: Kernel,
    pub sum_slots: Kernel,
    pub project_backward: Kernel,
    pub project_backward_adam: Kernel,
}

impl Kernels {
    /// For the views that `rasterizer` renders: both passes of the blending take the same form.
    pub fn new(rasterizer: &Rasterizer) -> Self {
        let (gpu, form) = (rasterizer.gpu(), rasterizer.form());
        let blending = rasterizer.blending();
        let kernel = |source: &shaders::ShaderSource| Kernel::new(gpu, source.name, "main", &source.text(blending));
        Self {
            loss_forward: kernel(&shaders::LOSS_FORWARD),
            loss_reduce: kernel(&shaders::LOSS_REDUCE),
            loss_backward: kernel(&shaders::LOSS_BACKWARD),
            surface_loss: blending.is_planar().then(|| kernel(&shaders::SURFACE_LOSS)),
            rasterize_backward: kernel(match form {
                BlendForm::Wide => &shaders::RASTERIZE_BACKWARD_WIDE,
                BlendForm::Narrow => &shaders::RASTERIZE_BACKWARD_NARROW,
            }),
            sum_slots: kernel(&shaders::SUM_SLOTS),
            project_backward: kernel(&shaders::PROJECT_BACKWARD),
            project_backward_adam: kernel(&shaders::PROJECT_BACKWARD_ADAM),
        }
    }
}
