//! Moving the map towards the keyframes: the image loss, its gradient, and Adam, all on the GPU.

mod adam;
mod image_buffers;
mod kernels;
mod loss;
mod scores;
mod tile_sampling;
mod trainer;

pub use adam::AdamConfig;
pub use loss::{LossConfig, LossTerms, Pixels, TargetImage, ssim_phase};
pub use scores::{ErrorPixels, GaussianScore};
pub use tile_sampling::TileSampling;
pub use trainer::{Gradients, ImageGradients, StepReport, Trainer, TrainerState, TrainingView};
