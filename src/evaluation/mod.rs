//! Measures a run: trajectory errors, image errors, and the report that holds them all.
//!
//! Knows nothing of how poses and pictures were made; rendering them is the caller's business.

mod comparison;
mod drawing;
mod exposures;
pub mod image;
pub mod machine;
pub mod metrics;
pub mod trajectory;
pub mod views;

pub use comparison::{Comparison, PoseRecord};
pub use drawing::draw_trajectory;
pub use exposures::{ExposureRecord, Exposures};
pub use image::{ImageError, ImageF32, depth_l1, psnr, psnr_where_lit, ssim};
pub use metrics::{Metrics, Times, sha256_hex, write_json};
pub use trajectory::{Alignment, AlignmentError, MAX_TIME_DIFFERENCE_S, TrajectoryErrors, evaluate_trajectory};
