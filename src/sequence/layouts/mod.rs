//! The table of dataset layouts, and one file for each. Adding one takes its file, with a [`LayoutRow`], and a row in [`LAYOUTS`].

mod colmap;
mod euroc;
mod images;
mod kitti;
mod replica;
mod row;
mod transforms;
mod tum;
mod video;

use std::path::Path;

use clap::builder::PossibleValue;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use crate::sequence::{Sequence, SequenceError};
pub(super) use row::LayoutRow;
pub(super) use video::Video;

/// All layouts, in the order of recognition: the first one whose marker files are there.
static LAYOUTS: [Layout; 8] = [
    Layout(&tum::LAYOUT),
    Layout(&kitti::LAYOUT),
    Layout(&euroc::LAYOUT),
    Layout(&colmap::LAYOUT),
    Layout(&replica::LAYOUT),
    Layout(&transforms::LAYOUT),
    Layout(&video::LAYOUT),
    Layout(&images::LAYOUT),
];

/// Arrangement of a dataset's files.
#[derive(Clone, Copy)]
pub struct Layout(&'static LayoutRow);

impl Layout {
    /// All layouts.
    pub fn all() -> &'static [Self] {
        &LAYOUTS
    }

    /// The layout of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        LAYOUTS.iter().copied().find(|layout| layout.name() == name)
    }

    /// Name on the command line and in configurations.
    pub fn name(self) -> &'static str {
        self.0.name
    }

    /// Whether its frames are photos with known poses, each a keyframe, instead of frames of a moving camera.
    pub fn is_photos(self) -> bool {
        self.0.is_photos
    }

    /// Parses `bytes` as each kind of file of the layout, in turn. Images, and videos behind their containers' headers, are left to their
    /// decoders.
    pub fn parse_files(self, bytes: &[u8]) -> Vec<Result<(), SequenceError>> {
        (self.0.parse)(bytes)
    }

    pub(super) fn of(row: &'static LayoutRow) -> Self {
        Self(row)
    }

    /// The layout of video files.
    pub(super) fn video() -> Self {
        Self(&video::LAYOUT)
    }

    pub(super) fn open(self, path: &Path, camera: Option<&str>) -> Result<Sequence, SequenceError> {
        match camera {
            Some(_) if !self.0.takes_camera => Err(SequenceError::OwnCamera { folder: path.into(), layout: self.name() }),
            camera => (self.0.open)(path, camera),
        }
    }

    /// The layout whose marker files are in `folder`.
    pub(super) fn recognise(folder: &Path) -> Option<Self> {
        LAYOUTS.iter().copied().find(|layout| (layout.0.recognise)(folder))
    }

    /// The layouts with their marker files, for messages.
    pub(super) fn known() -> String {
        let of = |layout: &Self| format!("{}: has {}", layout.0.name, layout.0.marker);
        LAYOUTS.iter().map(of).collect::<Vec<_>>().join(", ")
    }

    #[cfg(test)]
    pub(crate) fn named(name: &str) -> Self {
        Self::by_name(name).expect("the layout has a row")
    }
}

impl PartialEq for Layout {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for Layout {}

impl std::fmt::Debug for Layout {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl clap::ValueEnum for Layout {
    fn value_variants<'a>() -> &'a [Self] {
        &LAYOUTS
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.0.name).help(self.0.help))
    }
}

impl Serialize for Layout {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Layout {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        let known = || LAYOUTS.iter().map(|layout| layout.name()).collect::<Vec<_>>().join(", ");
        Self::by_name(&name).ok_or_else(|| de::Error::custom(format!("there is no layout `{name}`; known are {}", known())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_read_back() {
        for (i, layout) in LAYOUTS.iter().enumerate() {
            assert!(LAYOUTS[..i].iter().all(|other| other != layout), "{layout:?} has two rows");
            let text = serde_json::to_string(layout).unwrap();
            assert_eq!(serde_json::from_str::<Layout>(&text).unwrap(), *layout);
            assert!(Layout::known().contains(&format!("{}: has ", layout.name())));
        }
        let unknown = serde_json::from_str::<Layout>("\"kity\"").unwrap_err().to_string();
        assert!(unknown.contains("kity") && unknown.contains("kitti"), "{unknown}");
    }
}
