//! Residuals and least-squares solvers: poses, bundle adjustment, pose graphs, alignment. None knows the map.

pub mod bundle;
pub mod depth_bias;
pub mod epipolar;
pub mod intrinsics;
pub mod pixel_noise;
pub mod pose;
pub mod pose_equations;
pub mod pose_graph;
pub mod relative_pose;
pub mod residual;
pub mod schur;
pub mod sim3_alignment;
