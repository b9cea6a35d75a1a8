//! How much work a view really is: tile intersections, evaluations, blended evaluations, counted from the buffers that the GPU left.

use rayon::prelude::*;
use serde::Serialize;

use super::lanes::{Lanes, count_lanes};
use crate::gpu::GpuError;
use crate::optimise::Trainer;
use crate::render::layout::{SUBTILE_HEIGHT, SUBTILE_WIDTH, TILE_HEIGHT, TILE_WIDTH};
use crate::render::{BlendForm, GpuCloud, ViewCounts};
use crate::splat::model::{ALPHA_MAX, TRANSMITTANCE_MIN, ViewCamera};

/// Counted work of one view.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Work {
    /// Gaussians in the map.
    pub gaussians: u64,
    /// Gaussians that reach the image.
    pub visible: u64,
    /// Intersections of Gaussians with tiles.
    pub intersections: u64,
    /// (Gaussian, pixel) pairs whose exponent is computed in the forward pass: a tile's Gaussians times its pixels, in the wide form a sub-tile's, until all
    /// its pixels are finished.
    pub evaluations: u64,
    /// Those that are blended.
    pub blended: u64,
    /// Evaluations up to each tile's last contributor: the backward pass's share.
    pub backward_evaluations: u64,
    /// Pixels of the image.
    pub pixels: u64,
    /// Tiles of the image.
    pub tiles: u64,
    /// How evenly the lanes of a GPU share it.
    pub lanes: Lanes,
}

#[derive(Clone, Copy, Default)]
struct TileWork {
    evaluations: u64,
    blended: u64,
    backward_evaluations: u64,
}

/// Renders the view once more and counts.
///
/// # Errors
/// [`GpuError`] if a buffer does not fit or the device fails.
pub fn count_work(trainer: &mut Trainer, cloud: &GpuCloud, camera: &ViewCamera) -> Result<Work, GpuError> {
    let rasterizer = trainer.rasterizer_mut();
    let rendered = rasterizer.render(cloud, camera, [0.0; 3])?;
    let counts: ViewCounts = rasterizer.finish()?.unwrap_or_default();
    let gpu = rasterizer.gpu().clone();
    let (width, height) = (rendered.width, rendered.height);
    let tiles_x = width.div_ceil(TILE_WIDTH);
    let tiles = tiles_x * height.div_ceil(TILE_HEIGHT);
    let sorted = rasterizer.sorted(tiles);
    let ws = &rasterizer.workspace;
    let ranges: Vec<[u32; 2]> = ws.ranges.read(&gpu, 0, tiles as usize)?;
    let slots: Vec<u32> = ws.slots[sorted].read(&gpu, 0, counts.intersections as usize)?;
    let slot_gaussians: Vec<u32> = ws.slot_gaussians.read(&gpu, 0, counts.intersections as usize)?;
    let projected: Vec<[[f32; 4]; 3]> = ws.projected.read(&gpu, 0, cloud.len())?;
    let splat = |intersection: u32| {
        let gaussian = slot_gaussians[slots[intersection as usize] as usize] as usize;
        (projected[gaussian][0], projected[gaussian][1])
    };
    let (across, down) = match rasterizer.form() {
        BlendForm::Wide => (SUBTILE_WIDTH, SUBTILE_HEIGHT),
        BlendForm::Narrow => (TILE_WIDTH, TILE_HEIGHT),
    };
    let parts = |tile: u32| {
        let (x0, y0) = (tile % tiles_x * TILE_WIDTH, tile / tiles_x * TILE_HEIGHT);
        let rows = (y0..y0 + TILE_HEIGHT).step_by(down as usize);
        rows.flat_map(move |y| (x0..x0 + TILE_WIDTH).step_by(across as usize).map(move |x| (tile, x, y)))
    };
    let per_part: Vec<TileWork> = (0..tiles)
        .into_par_iter()
        .flat_map_iter(parts)
        .map(|(tile, x0, y0)| {
            let pixels = (y0..(y0 + down).min(height)).flat_map(|y| (x0..(x0 + across).min(width)).map(move |x| (x, y)));
            let least = (rasterizer.form() == BlendForm::Wide).then_some([x0 as f32, y0 as f32]);
            part_work(ranges[tile as usize], &pixels.collect::<Vec<_>>(), least, &splat)
        })
        .collect();
    let sum = |f: fn(&TileWork) -> u64| per_part.iter().map(f).sum();
    Ok(Work {
        gaussians: cloud.len() as u64,
        visible: u64::from(counts.visible),
        intersections: u64::from(counts.intersections),
        evaluations: sum(|t| t.evaluations),
        blended: sum(|t| t.blended),
        backward_evaluations: sum(|t| t.backward_evaluations),
        pixels: u64::from(width * height),
        tiles: u64::from(tiles),
        lanes: count_lanes(rasterizer, cloud, counts, height.div_ceil(TILE_HEIGHT))?,
    })
}

/// Of a tile, or of the sub-tile whose first pixel is `least`.
fn part_work(
    [first, end]: [u32; 2],
    pixels: &[(u32, u32)],
    least: Option<[f32; 2]>,
    splat: &dyn Fn(u32) -> ([f32; 4], [f32; 4]),
) -> TileWork {
    let mut work = TileWork::default();
    let mut transmittance = vec![1.0f32; pixels.len()];
    let mut finished = vec![false; pixels.len()];
    for intersection in first..end {
        // The GPU looks for finished tiles once per batch.
        if (intersection - first) % 64 == 0 && finished.iter().all(|f| *f) {
            break;
        }
        let (mean, conic_factor) = splat(intersection);
        if least.is_some_and(|least| !reaches(least, mean, conic_factor)) {
            continue;
        }
        work.evaluations += pixels.len() as u64;
        for (i, &(x, y)) in pixels.iter().enumerate() {
            if finished[i] {
                continue;
            }
            let (dx, dy) = (x as f32 - mean[0], y as f32 - mean[1]);
            let (u, v) = (conic_factor[0] * dx + conic_factor[1] * dy, conic_factor[2] * dy);
            let distance = u * u + v * v;
            if distance > mean[3] {
                continue;
            }
            let alpha = (conic_factor[3] * (-distance).exp()).min(ALPHA_MAX as f32);
            let next = transmittance[i] * (1.0 - alpha);
            if next < TRANSMITTANCE_MIN as f32 {
                finished[i] = true;
                continue;
            }
            transmittance[i] = next;
            work.blended += 1;
            work.backward_evaluations = work.evaluations;
        }
    }
    work
}

/// Whether the ellipse touches a sub-tile: the twin of `reaches` in `shaders/shared/pixels_wide.wgsl`.
fn reaches(least: [f32; 2], mean: [f32; 4], shape: [f32; 4]) -> bool {
    let (low_x, low_y) = (least[0] - mean[0], least[1] - mean[1]);
    let (high_x, high_y) = (low_x + (SUBTILE_WIDTH - 1) as f32, low_y + (SUBTILE_HEIGHT - 1) as f32);
    let (near_x, near_y) = (0f32.clamp(low_x, high_x), 0f32.clamp(low_y, high_y));
    let squared_distance = |x: f32, y: f32| (shape[0] * x + shape[1] * y).powi(2) + (shape[2] * y).powi(2);
    let x = (-shape[1] * near_y / shape[0]).clamp(low_x, high_x);
    let y = (-shape[0] * shape[1] * near_x / (shape[1] * shape[1] + shape[2] * shape[2])).clamp(low_y, high_y);
    squared_distance(x, near_y).min(squared_distance(near_x, y)) <= mean[3]
}
