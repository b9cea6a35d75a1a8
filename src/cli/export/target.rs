//! What `keysplat export` writes: a map, its levels of detail, a dataset for other trainers, or a trajectory.

use std::path::Path;
use std::sync::LazyLock;

use clap::ValueEnum;
use clap::builder::PossibleValue;
use keysplat::export::MapFormat;
use keysplat::export::dataset::DatasetFormat;
use keysplat::export::lod;

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The map.
    Map(MapFormat),
    /// The map in levels of detail, in a folder.
    Levels,
    /// Images with poses, and points.
    Dataset(DatasetFormat),
    /// All poses, as KITTI's odometry has them.
    Kitti,
}

static TARGETS: LazyLock<Vec<Target>> = LazyLock::new(|| {
    let maps = MapFormat::all().iter().copied().map(Target::Map);
    maps.chain([Target::Levels]).chain(DatasetFormat::ALL.map(Target::Dataset)).chain([Target::Kitti]).collect()
});

impl Target {
    /// What a file's name says.
    pub fn of_path(path: &Path) -> Option<Self> {
        match path.file_name().and_then(|name| name.to_str()) {
            Some("transforms.json") => Some(Self::Dataset(DatasetFormat::Transforms)),
            Some(lod::META) => Some(Self::Levels),
            _ => MapFormat::of_path(path).map(Self::Map),
        }
    }
}

impl ValueEnum for Target {
    fn value_variants<'a>() -> &'a [Self] {
        &TARGETS
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        match self {
            Self::Map(format) => format.to_possible_value(),
            Self::Levels => Some(
                PossibleValue::new("lod")
                    .help("Streamed SOG: levels of detail in a folder, for large maps in PlayCanvas and Babylon.js."),
            ),
            Self::Dataset(format) => Some(format.possible_value()),
            Self::Kitti => Some(PossibleValue::new("kitti").help("Text of all poses, as KITTI's odometry has them.")),
        }
    }
}
