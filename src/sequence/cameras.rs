//! Camera presets of known datasets, from `sequences/cameras.toml`.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::LazyLock;

use serde::Deserialize;

use super::SequenceError;
use crate::geometry::{Camera, Distortion, Pinhole};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Preset {
    folder_contains: String,
    pinhole: Pinhole,
    #[serde(default)]
    distortion: Distortion,
    depth_units_per_metre: f64,
}

impl Preset {
    fn camera(&self) -> Camera {
        Camera { pinhole: self.pinhole, distortion: self.distortion, depth_units_per_metre: self.depth_units_per_metre }
    }
}

static PRESETS: LazyLock<BTreeMap<String, Preset>> =
    LazyLock::new(|| toml::from_str(include_str!("../../sequences/cameras.toml")).expect("the embedded presets are valid"));

/// The names of all presets.
pub fn names() -> Vec<&'static str> {
    PRESETS.keys().map(String::as_str).collect()
}

/// Whether `name` is the path of a camera's file rather than a preset's name.
pub fn is_file(name: &str) -> bool {
    name.ends_with(".toml")
}

/// Name of the camera that is not known: a usual lens, for images of which the calibration is to be found.
pub const ASSUMED: &str = "auto";

/// A usual lens for images of this one's size.
pub fn assumed_for(image: &Path) -> Result<Camera, SequenceError> {
    let size = image::image_dimensions(image).map_err(|source| SequenceError::Image { path: image.into(), source })?;
    Ok(Camera::assumed(size.0, size.1))
}

/// The preset called `name`.
pub fn by_name(name: &str) -> Result<Camera, SequenceError> {
    PRESETS.get(name).map(Preset::camera).ok_or_else(|| SequenceError::UnknownCamera { name: name.into() })
}

/// The preset whose recordings have folder names like `folder`.
pub fn by_folder(folder: &str) -> Option<Camera> {
    let folder = folder.to_lowercase();
    PRESETS.values().find(|preset| folder.contains(&preset.folder_contains)).map(Preset::camera)
}

#[cfg(test)]
mod tests {
    #[test]
    fn presets_are_found_by_name_and_by_folder() {
        assert_eq!(super::by_folder("rgbd_dataset_freiburg1_desk").unwrap().pinhole.fx, 517.306408);
        assert_eq!(super::by_name("tum-fr2").unwrap().distortion.k3, 0.917205);
        assert!(super::by_folder("kitchen").is_none());
        assert!(super::by_name("leica").unwrap_err().to_string().contains("tum-fr3"));
    }
}
