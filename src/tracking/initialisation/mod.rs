//! The first two views of a camera without depth.

pub mod mono;
pub mod two_view;
