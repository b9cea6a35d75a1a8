//! The same passes without a step, for whoever wants the gradients.

use super::{Objective, Sink, Trainer, TrainingView, Viewpoint};
use crate::geometry::Pinhole;
use crate::gpu::{GpuBuffer, GpuError};
use crate::optimise::{LossConfig, LossTerms, TargetImage};
use crate::render::GpuCloud;
use crate::splat::{GaussianCloud, ViewCamera};

/// Gradient of a loss by the map.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// Terms of the image loss.
    pub loss: LossTerms,
    /// By the raw parameters of each Gaussian, in the shape of the map.
    pub cloud: GaussianCloud,
}

/// Gradient of a loss by a rendered image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImageGradients {
    /// `[H, W]` by colour (r, g, b) and by Σ w z, 1/metres.
    pub color_depth: Vec<[f32; 4]>,
    /// `[H, W]` by alpha.
    pub alpha: Vec<f32>,
    /// `[H, W]` by a planar surface's slopes and squared depth, see [`Rendered::surface`](crate::render::Rendered::surface); empty otherwise.
    pub surface: Vec<[f32; 4]>,
}

impl Trainer {
    /// Gradients of the image loss of a view by the map; moves nothing.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn gradients(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        target: &TargetImage,
        loss: &LossConfig,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let objective = Objective::Image { view: TrainingView::new(*camera, target), loss, log: 0 };
        let mut gradients = self.collect(cloud, camera, [0.0; 3], &objective)?;
        let loss: Vec<[f32; 4]> = self.logs[0].read(&gpu, 0, 1)?;
        gradients.loss = LossTerms::from_sums(loss[0], target.width * target.height);
        Ok(gradients)
    }

    /// Gradients of any loss by the map, from its gradients by the image; moves nothing.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn gradients_from_image(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        background: [f32; 3],
        by_image: &ImageGradients,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let Pinhole { width, height, .. } = camera.pinhole;
        self.choose_images((width, height))?;
        self.images[0].gradients.write(&gpu, 0, &by_image.color_depth);
        let alpha: Vec<[f32; 4]> = by_image.alpha.iter().map(|a| [*a, 0.0, 0.0, 0.0]).collect();
        self.images[0].gradients.write(&gpu, by_image.color_depth.len(), &alpha);
        if self.rasterizer.blending().is_planar() {
            self.images[0].gradients.write(&gpu, 2 * by_image.color_depth.len(), &by_image.surface);
        }
        self.collect(cloud, camera, background, &Objective::Given)
    }

    fn collect(
        &mut self,
        cloud: &GpuCloud,
        camera: &ViewCamera,
        background: [f32; 3],
        objective: &Objective<'_>,
    ) -> Result<Gradients, GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        let sink = GpuBuffer::storage(&gpu, "gradients", cloud.parameters().size())?;
        self.run(cloud, &Viewpoint { camera, background }, objective, &Sink::Gradient(&sink))?;
        let cloud = cloud.read_planes(&gpu, &sink)?;
        Ok(Gradients { loss: LossTerms::default(), cloud })
    }

    /// Submits one step and waits, again with larger buffers if its intersections did not fit.
    fn run(
        &mut self,
        cloud: &GpuCloud,
        viewpoint: &Viewpoint<'_>,
        objective: &Objective<'_>,
        sink: &Sink<'_>,
    ) -> Result<(), GpuError> {
        let gpu = self.rasterizer.gpu().clone();
        loop {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if let Sink::Gradient(buffer) = sink {
                gpu.clear(&mut encoder, buffer, 0, None);
            }
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.rasterizer.uniforms.begin();
            self.encode(&mut pass, cloud, viewpoint, objective, sink)?;
            drop(pass);
            self.rasterizer.uniforms.upload(&gpu);
            gpu.submit(encoder);
            if self.rasterizer.finish()?.is_some() {
                return Ok(());
            }
        }
    }
}
