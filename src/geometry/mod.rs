//! Rigid motions, similarities, camera models and trajectories, in f64. Knows nothing of images, files of datasets, or Gaussians.

pub mod alignment;
pub mod camera;
pub mod se3;
pub mod sim3;
pub mod trajectory;

pub use alignment::align;
pub use camera::{Camera, Distortion, Pinhole};
pub use se3::Se3;
pub use sim3::Sim3;
pub use trajectory::{StampedPose, Trajectory, TrajectoryError};
