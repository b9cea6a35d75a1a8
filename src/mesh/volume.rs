//! The sparse volume: blocks of 8³ voxels where views saw a surface, in the order of their keys.

use std::collections::{HashMap, HashSet};

use glam::Vec3;
use nalgebra::{Point3, Vector2};
use rayon::prelude::*;

use super::config::MOST_VOXEL_METRES;
use super::{DepthView, MeshConfig, MeshError};

/// Voxels along a block's side.
pub(super) const SIDE: usize = 8;
/// Voxels of a block.
pub(super) const VOXELS: usize = SIDE * SIDE * SIDE;
/// Memory of a block: its voxels and its key. The mesh comes on top, when the views are gone.
const BLOCK_BYTES: u64 = (VOXELS * size_of::<Voxel>() + 256) as u64;
/// Voxel sizes are tried in steps of this factor until the blocks fit.
const COARSER: f64 = 1.25;

/// Place of a block: its first voxel's, over the side.
pub(super) type Key = [i32; 3];

/// What is known of the distance at a voxel's centre.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Voxel {
    /// Mean signed distance, metres, positive in front of the surface.
    pub distance: f32,
    /// Sum of the weights.
    pub weight: f32,
    /// Mean sRGB, in 256ths.
    pub color: [u16; 3],
    /// Views that saw it.
    pub views: u16,
}

/// A block of voxels, x fastest.
#[derive(Clone, Debug)]
pub(super) struct Block {
    pub key: Key,
    pub voxels: Box<[Voxel]>,
}

/// All blocks, sorted by key.
#[derive(Debug)]
pub(super) struct Volume {
    pub voxel_metres: f64,
    pub blocks: Vec<Block>,
    places: HashMap<Key, u32>,
}

impl Volume {
    /// Empty blocks of the keys, which are sorted.
    pub fn new(voxel_metres: f64, keys: &[Key]) -> Self {
        let empty = |key: &Key| Block { key: *key, voxels: vec![Voxel::default(); VOXELS].into() };
        let places = keys.iter().enumerate().map(|(place, key)| (*key, place as u32)).collect();
        Self { voxel_metres, blocks: keys.iter().map(empty).collect(), places }
    }

    /// Where the block of a key lies among the blocks.
    pub fn place(&self, key: &Key) -> Option<usize> {
        self.places.get(key).map(|place| *place as usize)
    }

    /// Centre of a voxel, metres.
    pub fn position(&self, key: Key, local: [usize; 3]) -> Vec3 {
        let at = |axis: usize| (f64::from(key[axis]) * SIDE as f64 + local[axis] as f64) * self.voxel_metres;
        Vec3::new(at(0) as f32, at(1) as f32, at(2) as f32)
    }
}

/// The blocks within the truncation of what the views saw, sorted.
///
/// # Errors
/// [`MeshError::TooLarge`] if they do not fit, with a voxel size whose blocks do.
pub(super) fn fitting_blocks(views: &[DepthView], config: &MeshConfig, bytes: u64) -> Result<Vec<Key>, MeshError> {
    let most = usize::try_from(bytes / BLOCK_BYTES).unwrap_or(usize::MAX);
    let counted = match blocks(views, config, most) {
        Ok(keys) => return Ok(keys),
        Err(counted) => counted,
    };
    let mut fits = config.clone();
    while blocks(views, &fits, most).is_err() {
        fits.voxel_metres *= COARSER;
        if fits.voxel_metres > MOST_VOXEL_METRES {
            let of_views: u64 = views.iter().map(DepthView::bytes).sum();
            let needed_mib = (of_views + counted as u64 * BLOCK_BYTES).div_ceil(1 << 20);
            return Err(MeshError::TooManyViews { views: views.len(), needed_mib });
        }
    }
    // Two digits, upwards: a size that somebody may type.
    let digits = 1.0 - fits.voxel_metres.log10().floor();
    let rounded = (fits.voxel_metres * 10f64.powf(digits)).ceil() / 10f64.powf(digits);
    let mib = |blocks: u64| (blocks * BLOCK_BYTES).div_ceil(1 << 20);
    Err(MeshError::TooLarge {
        voxel: config.voxel_metres,
        needed_mib: mib(counted as u64),
        available_mib: bytes >> 20,
        fits: rounded,
    })
}

/// The blocks, or how many there were when they became more than `most`.
fn blocks(views: &[DepthView], config: &MeshConfig, most: usize) -> Result<Vec<Key>, usize> {
    let mut all: HashSet<Key> = HashSet::new();
    // So many views at a time that their keys need little memory.
    for batch in views.chunks(rayon::current_num_threads()) {
        let of_views: Vec<HashSet<Key>> = batch.par_iter().map(|view| blocks_of(view, config)).collect();
        of_views.into_iter().for_each(|keys| all.extend(keys));
        if all.len() > most {
            return Err(all.len());
        }
    }
    let mut keys: Vec<Key> = all.into_iter().collect();
    keys.sort_unstable();
    Ok(keys)
}

/// The blocks along each pixel's ray, as far as the truncation before and behind the surface.
fn blocks_of(view: &DepthView, config: &MeshConfig) -> HashSet<Key> {
    let (truncation, block) = (config.truncation_metres(), config.voxel_metres * SIDE as f64);
    let steps = (4.0 * truncation / block).ceil() as i32;
    let width = view.pinhole.width as usize;
    let mut keys = HashSet::new();
    let mut last = None;
    for (i, inverse) in view.inverse_depth.iter().enumerate().filter(|(_, inverse)| **inverse > 0.0) {
        let ray = view.pinhole.unproject(&Vector2::new((i % width) as f64, (i / width) as f64), 1.0);
        let surface = Point3::from(ray / f64::from(*inverse));
        let along = ray.normalize();
        for step in 0..=steps {
            let off = truncation * (2.0 * f64::from(step) / f64::from(steps) - 1.0);
            let p = view.world_from_camera * (surface + along * off);
            let key: Key = [0, 1, 2].map(|axis| (p[axis] / block).floor() as i32);
            if last != Some(key) {
                keys.insert(key);
                last = Some(key);
            }
        }
    }
    keys
}
