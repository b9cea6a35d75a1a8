//! Writes streamed SOG: `lod-meta.json`, and a folder of images for each piece of a level.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use super::Levels;
use super::cells::Tree;
use super::merge::Blob;
use crate::export::{ExportError, sog};
use crate::files::{WriteError, write_atomically};
use crate::geometry::Se3;
use crate::splat::GaussianCloud;

/// The file that viewers open.
pub const META: &str = "lod-meta.json";
const VERSION: u32 = 1;
/// Gaussians beyond which a piece takes no further cell.
const MANY_IN_PIECE: usize = 1 << 16;
/// How far Gaussians reach, in standard deviations: viewers draw them up to here.
const REACH: f64 = 2.83;

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Meta {
    version: u32,
    asset: Asset,
    count: usize,
    counts: Vec<usize>,
    lod_levels: usize,
    filenames: Vec<String>,
    tree: Node,
}

#[derive(Serialize)]
struct Asset {
    generator: String,
}

/// A node of the tree: a leaf has levels, all others have children.
#[derive(Serialize)]
struct Node {
    bound: Bound,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    children: Vec<Node>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    lods: BTreeMap<usize, Run>,
}

/// A cell's Gaussians at a level: so many in a piece, from an offset on.
#[derive(Clone, Copy, Serialize)]
struct Run {
    file: usize,
    offset: usize,
    count: usize,
}

/// A box around Gaussians, metres.
#[derive(Clone, Copy, Serialize)]
struct Bound {
    min: [f32; 3],
    max: [f32; 3],
}

impl Bound {
    const NONE: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    fn joined(self, other: Self) -> Self {
        let pick = |a: [f32; 3], b: [f32; 3], pick: fn(f32, f32) -> f32| [0, 1, 2].map(|k| pick(a[k], b[k]));
        Self { min: pick(self.min, other.min, f32::min), max: pick(self.max, other.max, f32::max) }
    }

    /// Of a Gaussian, as far as it is drawn.
    fn of(cloud: &GaussianCloud, i: usize) -> Self {
        let blob = Blob::new(cloud, i);
        let reach = [0, 1, 2].map(|k| REACH * blob.covariance[(k, k)].sqrt());
        let side = |sign: f64| {
            [0, 1, 2].map(|k| (blob.mean[k] + sign * reach[k]).clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32)
        };
        Self { min: side(-1.0), max: side(1.0) }
    }

    /// Of cells without Gaussians, a point.
    fn closed(self) -> Self {
        if self.min[0] <= self.max[0] { self } else { Self { min: [0.0; 3], max: [0.0; 3] } }
    }
}

/// What viewers load at once: cells of a level, side by side.
pub(super) struct Piece {
    pub level: usize,
    /// Number among the pieces of its level.
    pub number: usize,
    pub cells: Vec<usize>,
}

impl Piece {
    fn folder(&self) -> String {
        format!("{}_{}", self.level, self.number)
    }
}

impl Levels {
    /// Writes the levels into a new or empty folder, for cameras at these poses (world from camera), which may be none. Returns the bytes written.
    /// `lod-meta.json` is written last: a folder without it is not whole. After an error, nothing is left.
    ///
    /// # Errors
    /// If the folder has files, a value of the map is not finite, or a file cannot be written.
    pub fn write(&self, cameras: &[Se3], folder: &Path) -> Result<u64, ExportError> {
        let error = |source: std::io::Error| ExportError::from(WriteError { path: folder.into(), source });
        let is_new = !folder.exists();
        if !is_new && std::fs::read_dir(folder).map_err(error)?.next().is_some() {
            return Err(error(std::io::ErrorKind::DirectoryNotEmpty.into()));
        }
        std::fs::create_dir_all(folder).map_err(error)?;
        let pieces = self.pieces();
        self.write_files(&pieces, cameras, folder).inspect_err(|_| {
            // Best effort: what failed is more worth telling than what is left over.
            pieces.iter().for_each(|piece| drop(std::fs::remove_dir_all(folder.join(piece.folder()))));
            let _ = if is_new { std::fs::remove_dir(folder) } else { Ok(()) };
        })
    }

    fn write_files(&self, pieces: &[Piece], cameras: &[Se3], folder: &Path) -> Result<u64, ExportError> {
        let mut runs = vec![BTreeMap::new(); self.levels[0].len()];
        let mut bytes = 0;
        for (file, piece) in pieces.iter().enumerate() {
            let folder = folder.join(piece.folder());
            std::fs::create_dir(&folder).map_err(|source| WriteError { path: folder.clone(), source })?;
            let cells = &self.levels[piece.level];
            let mut together = cells[0].emptied();
            for cell in &piece.cells {
                let run = Run { file, offset: together.len(), count: cells[*cell].len() };
                runs[*cell].insert(piece.level, run);
                // Neighbours side by side compress well.
                together.append(&cells[*cell].picked(sog::order(&cells[*cell].means).into_iter()));
            }
            for written in sog::files(together, cameras)? {
                write_atomically(&folder.join(written.name), &written.bytes)?;
                bytes += written.bytes.len() as u64;
            }
        }
        let meta =
            serde_json::to_vec(&self.meta(pieces, &runs)).map_err(|error| ExportError::Encode { reason: error.to_string() })?;
        write_atomically(&folder.join(META), &meta)?;
        Ok(bytes + meta.len() as u64)
    }

    pub(super) fn pieces(&self) -> Vec<Piece> {
        let mut pieces: Vec<Piece> = Vec::new();
        for (level, cells) in self.levels.iter().enumerate() {
            let (mut number, mut held) = (0, 0);
            for cell in (0..cells.len()).filter(|cell| !cells[*cell].is_empty()) {
                match pieces.last_mut().filter(|piece| piece.level == level && held < MANY_IN_PIECE) {
                    Some(piece) => piece.cells.push(cell),
                    None => {
                        number += usize::from(held > 0);
                        held = 0;
                        pieces.push(Piece { level, number, cells: vec![cell] });
                    }
                }
                held += cells[cell].len();
            }
        }
        pieces
    }

    fn meta(&self, pieces: &[Piece], runs: &[BTreeMap<usize, Run>]) -> Meta {
        let counts = self.counts();
        Meta {
            version: VERSION,
            asset: Asset { generator: concat!("keysplat ", env!("CARGO_PKG_VERSION")).into() },
            count: counts.iter().sum(),
            lod_levels: counts.len(),
            counts,
            filenames: pieces.iter().map(|piece| format!("{}/{}", piece.folder(), sog::META)).collect(),
            tree: self.node(&self.tree, runs),
        }
    }

    fn node(&self, tree: &Tree, runs: &[BTreeMap<usize, Run>]) -> Node {
        match tree {
            Tree::Branch(parts) => {
                let children: Vec<Node> = parts.iter().map(|part| self.node(part, runs)).collect();
                let bound = children.iter().fold(Bound::NONE, |bound, child| bound.joined(child.bound));
                Node { bound, children, lods: BTreeMap::new() }
            }
            Tree::Leaf(cell) => {
                let clouds = self.levels.iter().map(|level| &level[*cell]);
                let all = clouds.flat_map(|cloud| (0..cloud.len()).map(move |i| Bound::of(cloud, i)));
                Node { bound: all.fold(Bound::NONE, Bound::joined).closed(), children: Vec::new(), lods: runs[*cell].clone() }
            }
        }
    }
}
