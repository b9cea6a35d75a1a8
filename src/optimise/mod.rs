//! Moving the map towards the keyframes: the image loss, its gradient, and Adam, all on the GPU.

mod adam;
mod density;
mod image_buffers;
mod kernels;
mod loss;
mod scores;
mod surface_loss;
mod survey;
mod trainer;

pub use adam::AdamConfig;
pub use density::{DensityPasses, Verdicts};
pub use loss::{LossConfig, LossTerms, Pixels, TargetImage, ssim_phase};
pub use scores::{ErrorPixels, GaussianScore, OverScores};
pub use surface_loss::PlanarConfig;
pub use survey::{SampledPixel, Survey, SurveyRules, SurveyedCell};
pub use trainer::{Gradients, ImageGradients, StepReport, Trainer, TrainerState, TrainingView};
