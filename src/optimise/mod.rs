//! Moving the map towards the keyframes: the image loss, its gradient, and Adam, all on the GPU.

mod adam;
mod image_buffers;
mod kernels;
mod loss;
mod optimiser;
mod scores;
mod tile_sampling;

pub use adam::AdamConfig;
pub use loss::{LossConfig, LossTerms, TargetImage};
pub use optimiser::{Gradients, Optimiser, OptimiserState, StepReport, TrainingView};
pub use scores::{GaussianScore, WrongPixels};
pub use tile_sampling::TileSampling;
