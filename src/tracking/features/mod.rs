//! ORB keypoints and descriptors of a frame, their depths, and matching; its pixels for dense alignment.

pub mod dense_frame;
pub mod descriptor;
pub mod fast;
pub mod frame_features;
pub mod matching;
pub mod orb;
pub mod orientation;
pub mod projection;
pub mod quadtree;
pub mod steered_brief;
pub mod stereo;
