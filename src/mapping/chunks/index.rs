//! Chunks by the cell of space that they lie in and by the keyframes of their Gaussians, so that none is looked at in vain.

use std::collections::{BTreeMap, BTreeSet};

use super::{ChunkId, OrientedBox, Outlook};
use crate::mapping::KeyframeId;

/// Side of a cell, metres. It decides how long a search takes, not what it finds.
const CELL_METRES: f32 = 4.0;

#[derive(Debug)]
struct Cell {
    /// Around the boxes of all that came into it.
    bounds: OrientedBox,
    chunks: BTreeMap<ChunkId, OrientedBox>,
}

/// All chunks that are away.
#[derive(Debug, Default)]
pub(super) struct Index {
    cells: BTreeMap<[i32; 3], Cell>,
    keyframes: BTreeMap<KeyframeId, BTreeSet<ChunkId>>,
}

impl Index {
    pub fn insert(&mut self, id: ChunkId, bounds: OrientedBox) {
        let cell = self.cells.entry(cell_of(&bounds)).or_insert_with(|| Cell { bounds, chunks: BTreeMap::new() });
        cell.bounds = OrientedBox::around_boxes(&[cell.bounds, bounds]);
        cell.chunks.insert(id, bounds);
    }

    pub fn remove(&mut self, id: ChunkId, bounds: &OrientedBox) {
        let key = cell_of(bounds);
        if let Some(cell) = self.cells.get_mut(&key) {
            cell.chunks.remove(&id);
            if cell.chunks.is_empty() {
                self.cells.remove(&key);
            }
        }
    }

    /// A chunk has Gaussians of these keyframes.
    pub fn name<'a>(&mut self, id: ChunkId, keyframes: impl IntoIterator<Item = &'a KeyframeId>) {
        keyframes.into_iter().for_each(|keyframe| {
            self.keyframes.entry(*keyframe).or_default().insert(id);
        });
    }

    pub fn forget<'a>(&mut self, id: ChunkId, keyframes: impl IntoIterator<Item = &'a KeyframeId>) {
        for keyframe in keyframes {
            if let Some(chunks) = self.keyframes.get_mut(keyframe) {
                chunks.remove(&id);
            }
        }
    }

    /// Chunks with Gaussians of some keyframes.
    pub fn of_keyframes<'a>(&self, keyframes: impl IntoIterator<Item = &'a KeyframeId>) -> BTreeSet<ChunkId> {
        keyframes.into_iter().filter_map(|keyframe| self.keyframes.get(keyframe)).flatten().copied().collect()
    }

    /// Chunks that a view sees, in any order.
    pub fn seen_by<'a>(&'a self, outlook: &'a Outlook<'_>) -> impl Iterator<Item = (ChunkId, &'a OrientedBox)> {
        let cells = self.cells.values().filter(|cell| outlook.faces(&cell.bounds));
        cells.flat_map(|cell| &cell.chunks).filter(|(_, bounds)| outlook.sees(bounds)).map(|(id, bounds)| (*id, bounds))
    }
}

impl<'a> FromIterator<(ChunkId, &'a OrientedBox)> for Index {
    fn from_iter<T: IntoIterator<Item = (ChunkId, &'a OrientedBox)>>(chunks: T) -> Self {
        let mut index = Self::default();
        chunks.into_iter().for_each(|(id, bounds)| index.insert(id, *bounds));
        index
    }
}

fn cell_of(bounds: &OrientedBox) -> [i32; 3] {
    bounds.center().to_array().map(|coordinate| (coordinate / CELL_METRES).floor() as i32)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use image::RgbImage;
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::{Pinhole, Se3};
    use crate::mapping::chunks::Sight;
    use crate::sequence::{DepthImage, RectifiedImage};
    use crate::splat::ViewCamera;

    proptest! {
        #[test]
        fn the_index_finds_what_a_look_at_each_finds(
            boxes in prop::collection::vec(prop::array::uniform4(-12.0f32..12.0), 1..80),
            (x, turn, depth) in (-8.0f64..8.0, -3.0f64..3.0, 1.0f32..9.0),
            removed in prop::collection::vec(any::<prop::sample::Index>(), 0..20),
        ) {
            let pinhole = Pinhole { fx: 32.0, fy: 32.0, cx: 15.5, cy: 11.5, width: 32, height: 24 };
            let depth = DepthImage { width: 32, height: 24, metres: vec![depth; 32 * 24] };
            let image = RectifiedImage { pinhole, color: RgbImage::new(32, 24), depth: Some(depth), valid: None };
            let camera_from_world = Se3::new([x, 0.0, 0.5].into(), [0.0, turn, 0.0].into());
            let sight = Sight::of(&image);
            let outlook = sight.from(&ViewCamera { pinhole, camera_from_world });
            let mut chunks: BTreeMap<ChunkId, OrientedBox> =
                (0..).zip(boxes).map(|(id, [x, y, z, r])| (id, OrientedBox::cube(Vec3::new(x, y, z), r.abs() / 8.0))).collect();
            let mut index: Index = chunks.iter().map(|(id, bounds)| (*id, bounds)).collect();
            for which in removed {
                let id = which.index(100) as ChunkId;
                if let Some(bounds) = chunks.remove(&id) {
                    index.remove(id, &bounds);
                }
            }
            let found: BTreeSet<ChunkId> = index.seen_by(&outlook).map(|(id, _)| id).collect();
            let expected: BTreeSet<ChunkId> = chunks.iter().filter(|(_, bounds)| outlook.sees(bounds)).map(|(id, _)| *id).collect();
            prop_assert_eq!(found, expected);
        }
    }
}
