//! Measures what the levels of detail of a run's map change: each level against the map, from the distance at which viewers take it.
//!
//! usage: cargo run --release --example level_of_detail -- FOLDER [VIEWS] [METRES FACTOR]
//!
//! A viewer at that distance sees what a keyframe sees, with fewer pixels. So each keyframe's view is rendered at the resolution at which its median
//! depth has the pixels that it would have on 1080 lines from the distance. Pruning to the same number of Gaussians is measured beside it.

use std::error::Error;
use std::path::PathBuf;

use keysplat::Gpu;
use keysplat::evaluation::image::{ImageError, ImageF32, psnr};
use keysplat::export::lod::{DISTANCE_FACTOR, Levels, PIXELS};
use keysplat::export::{ExportFilter, MapFormat};
use keysplat::geometry::{Pinhole, Se3, Trajectory};
use keysplat::gpu::GpuError;
use keysplat::render::{GpuCloud, Rasterizer, Rendered};
use keysplat::splat::{GaussianCloud, ViewCamera};

/// Lines at which the depth of a view is measured.
const LINES: f64 = 240.0;
const LEAST_LINES: f64 = 16.0;
const ASPECT: f64 = 4.0 / 3.0;
/// Half the vertical field of view, degrees.
const HALF_FIELD: f64 = 22.5;
const USAGE: &str = "usage: level_of_detail FOLDER [VIEWS] [METRES FACTOR]";

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = PathBuf::from(arguments.first().ok_or(USAGE)?);
    let number = |k: usize| arguments.get(k).map(|text| text.parse::<f64>()).transpose();
    let map = MapFormat::default().read(&folder.join("map.ply"))?;
    let levels = Levels::new(&map);
    let base = number(2)?.or(levels.base_distance()).ok_or("the map is so small that it has one level")?;
    let factor = number(3)?.unwrap_or(DISTANCE_FACTOR);
    let keyframes = Trajectory::read_tum(&folder.join("keyframes.txt"))?.poses;
    let step = keyframes.len().div_ceil(number(1)?.map_or(12, |views| views as usize)).max(1);
    let poses = keyframes.iter().step_by(step).map(|pose| pose.world_from_camera);
    let mut viewer = Viewer::new(&map, poses)?;
    println!(
        "| level | Gaussians | distance, m | merged: PSNR, dB | worst view, dB | mean difference, 1/255 | pruned: PSNR, dB |"
    );
    println!("|---|---|---|---|---|---|---|");
    for (level, count) in levels.counts().into_iter().enumerate().skip(1) {
        let distance = base * factor.powi(level as i32 - 1);
        let exact = viewer.render(&map, distance)?;
        let merged = Difference::of(&viewer.render(&levels.level(level), distance)?, &exact)?;
        let few = ExportFilter { max_gaussians: Some(count), ..ExportFilter::default() }.apply(&map);
        let pruned = Difference::of(&viewer.render(&few, distance)?, &exact)?;
        let Difference { psnr, worst, mean } = merged;
        println!("| {level} | {count} | {distance:.1} | {psnr:.1} | {worst:.1} | {mean:.1} | {:.1} |", pruned.psnr);
    }
    Ok(())
}

/// Keyframes' views with their median depths, metres.
struct Viewer {
    rasterizer: Rasterizer,
    views: Vec<(Se3, f64)>,
}

impl Viewer {
    fn new(map: &GaussianCloud, poses: impl Iterator<Item = Se3>) -> Result<Self, GpuError> {
        let mut rasterizer = Rasterizer::new(Gpu::open(None)?)?;
        let on_gpu = GpuCloud::of(rasterizer.gpu(), map)?;
        let mut views = Vec::new();
        for pose in poses {
            let rendered = rasterizer.render(&on_gpu, &camera(&pose, LINES), [0.0; 3])?;
            let depths = (0..rendered.transmittance.len()).map(|i| rendered.expected_depth(i));
            let mut depths: Vec<f32> = depths.filter(|depth| *depth > 0.0).collect();
            depths.sort_by(f32::total_cmp);
            views.extend(depths.get(depths.len() / 2).map(|depth| (pose, f64::from(*depth))));
        }
        Ok(Self { rasterizer, views })
    }

    /// The views from this distance, metres.
    fn render(&mut self, map: &GaussianCloud, distance: f64) -> Result<Vec<Rendered>, GpuError> {
        let on_gpu = GpuCloud::of(self.rasterizer.gpu(), map)?;
        let lines = 2.0 * PIXELS * HALF_FIELD.to_radians().tan();
        let camera = |(pose, depth): &(Se3, f64)| camera(pose, lines * depth / distance);
        self.views.iter().map(|view| self.rasterizer.render(&on_gpu, &camera(view), [0.0; 3])).collect()
    }
}

fn camera(pose: &Se3, lines: f64) -> ViewCamera {
    let height = lines.round().max(LEAST_LINES);
    let width = (ASPECT * height).round();
    let focal = 0.5 * height / HALF_FIELD.to_radians().tan();
    let (cx, cy) = (0.5 * width - 0.5, 0.5 * height - 0.5);
    let pinhole = Pinhole { fx: focal, fy: focal, cx, cy, width: width as u32, height: height as u32 };
    ViewCamera { pinhole, camera_from_world: pose.inverse() }
}

/// Of views against those of the map: mean PSNR, least PSNR, and mean absolute difference in 255ths.
struct Difference {
    psnr: f64,
    worst: f64,
    mean: f64,
}

impl Difference {
    fn of(views: &[Rendered], exact: &[Rendered]) -> Result<Self, ImageError> {
        let (mut psnrs, mut means) = (Vec::new(), Vec::new());
        for (view, exact) in views.iter().zip(exact) {
            let (a, b) = (image(view), image(exact));
            psnrs.push(psnr(&a, &b)?);
            let differences = a.pixels.iter().zip(&b.pixels).flat_map(|(a, b)| [0, 1, 2].map(|c| f64::from((a[c] - b[c]).abs())));
            means.push(255.0 * differences.sum::<f64>() / (3 * a.pixels.len()) as f64);
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        Ok(Self { psnr: mean(&psnrs), worst: psnrs.iter().copied().fold(f64::INFINITY, f64::min), mean: mean(&means) })
    }
}

fn image(rendered: &Rendered) -> ImageF32 {
    let pixels = rendered.color_depth.iter().map(|p| [p[0], p[1], p[2]]).collect();
    ImageF32::new(rendered.width as usize, rendered.height as usize, pixels).expect("a render has all its pixels").clamped()
}
