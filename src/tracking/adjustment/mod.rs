//! Local and global bundle adjustment of the map.

pub mod local_bundle;
