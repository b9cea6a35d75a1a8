//! The pose of a frame in the map: from landmarks, from similar keyframes, or from all pixels.

pub mod dense_alignment;
pub mod localise;
pub mod pnp;
