//! Local and global bundle adjustment of the map, in a thread of its own.

pub mod local_bundle;
