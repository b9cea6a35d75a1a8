//! Dataset layouts, damaged files, image metrics against scikit-image, and the structure of the sources.

#[path = "../common/mod.rs"]
mod common;

mod architecture;
mod documents;
mod hostile_files;
mod layouts;
mod scikit_image;
