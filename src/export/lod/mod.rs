//! A map in levels of detail for viewers that stream it: PlayCanvas' streamed SOG, version 1 (read by its engine and by Babylon.js).
//!
//! Level 0 is the map. Each further level has a quarter of the Gaussians: neighbours are merged, as in Hierarchical 3DGS (Kerbl et al. 2024), and
//! none is dropped. Left out: the hierarchy that one renders a cut of, and environments.

mod cells;
mod merge;
mod simplify;
#[cfg(test)]
mod tests;
mod write;

pub use write::META;

use cells::{MOST_IN_CELL, Tree};
use simplify::{median_extent, simplified};

use crate::splat::GaussianCloud;

/// Gaussians of a level over those of the next: half the resolution on a surface.
const RATIO: usize = 4;
/// Factor between the distances of two levels: that of their resolutions.
pub const DISTANCE_FACTOR: f64 = 2.0;
/// A level of so few is the last.
const FEW: usize = 4096;
/// Levels, at most: presets of viewers name six.
const MOST_LEVELS: usize = 6;
/// Pixels of a metre at a metre's distance, on 1080 lines with a vertical field of view of 45°, for which viewers state distances.
pub const PIXELS: f64 = 1303.7;

/// A map in levels of detail. A cell holds the same part of the map at each level.
pub struct Levels {
    tree: Tree,
    /// `[levels][cells]`.
    levels: Vec<Vec<GaussianCloud>>,
}

impl Levels {
    /// Divides a map into cells and merges the Gaussians of each cell, level by level. The same map gives the same levels.
    pub fn new(cloud: &GaussianCloud) -> Self {
        let (tree, leaves) = cells::divide(&cloud.means, MOST_IN_CELL);
        let mut levels: Vec<Vec<GaussianCloud>> = vec![leaves.iter().map(|leaf| cloud.picked(leaf.iter().copied())).collect()];
        while let Some(last) = levels.last().filter(|last| count(last) > FEW && levels.len() < MOST_LEVELS) {
            let next = simplified(last.clone(), count(last) / RATIO);
            // Cells of one Gaussian each are not merged further.
            if 2 * count(&next) > count(last) {
                break;
            }
            levels.push(next);
        }
        Self { tree, levels }
    }

    /// Gaussians of each level.
    pub fn counts(&self) -> Vec<usize> {
        self.levels.iter().map(|level| count(level)).collect()
    }

    /// The whole map at a level; empty beyond the last.
    pub fn level(&self, level: usize) -> GaussianCloud {
        let cells = self.levels.get(level).map_or(&[][..], Vec::as_slice);
        let mut whole = self.levels[0][0].emptied();
        cells.iter().for_each(|cell| whole.append(cell));
        whole
    }

    /// The distance from which level 1 suffices, metres: the standard deviation of its median Gaussian is a pixel there. None where there is only one level.
    pub fn base_distance(&self) -> Option<f64> {
        self.levels.get(1).map(|level| median_extent(level) * PIXELS)
    }
}

fn count(cells: &[GaussianCloud]) -> usize {
    cells.iter().map(GaussianCloud::len).sum()
}
