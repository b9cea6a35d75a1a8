//! Renders the final map at estimated poses and compares with what the camera recorded, by the three protocols in use.
//!
//! Images are compared at the mapping resolution, without lens distortion, with the camera's own principal point.

use std::collections::BTreeSet;
use std::sync::Arc;

use image::{Rgb, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Exposures;
use super::image::{ImageF32, depth_l1, psnr, psnr_where_lit, ssim};
use super::metrics::{ImageMeans, ImageProtocols};
use crate::geometry::Se3;
use crate::gpu::{Gpu, GpuError};
use crate::render::{GpuCloud, Rasterizer, Rendered};
use crate::sequence::{RectifiedImage, Rectifier, Sequence};
use crate::splat::GaussianCloud;
use crate::splat::ViewCamera;

/// MonoGS compares every 5th frame.
const MONOGS_EVERY: usize = 5;
/// Views decoded and compared side by side.
const BATCH: usize = 8;

/// Which views are compared, and how they count.
pub struct ViewSelection<'a> {
    /// `(frame index, world_from_camera)` of every posed frame.
    pub poses: &'a [(usize, Se3)],
    /// Frame indices of keyframes.
    pub keyframes: &'a BTreeSet<usize>,
    /// Whether a frame index was withheld from the mapper.
    pub is_held_out: &'a (dyn Fn(usize) -> bool + Sync),
    /// The camera's over time, by the keyframes alone: renders of held-out views get them before they are compared.
    pub exposures: &'a Exposures,
}

/// One held-out view beside what was recorded.
pub struct ComparedView {
    /// Quality of the rendered view.
    pub figures: ViewRecord,
    /// The recorded image, rectified.
    pub recorded: RgbImage,
    /// The rendered image, with exposure applied.
    pub rendered: RgbImage,
}

/// How well a view is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewRecord {
    /// Its index in the sequence as replayed.
    pub frame: usize,
    /// `null` where both images are equal.
    pub psnr_db: Option<f64>,
    /// SSIM over all pixels.
    pub ssim: f64,
    /// Where the sensor has depth.
    pub depth_l1_m: Option<f64>,
}

struct ViewFigures {
    psnr: f64,
    psnr_lit: f64,
    ssim: f64,
    depth_l1: Option<f64>,
}

/// A map and the recording that it is compared with.
#[derive(Clone, Copy, Debug)]
pub struct ViewSource<'a> {
    /// Recorded frames.
    pub sequence: &'a Sequence,
    /// Resolution to compare at, as a share of the recorded one.
    pub map_scale: f64,
    /// Adapter that renders.
    pub gpu: &'a Arc<Gpu>,
    /// The map.
    pub cloud: &'a GaussianCloud,
}

/// Compares all posed views with their renders. Frames that cannot be read are left out. `on_held_out` receives each held-out view, `on_view`
/// the number of views done.
///
/// # Errors
/// If the adapter fails.
pub fn evaluate_views(
    source: ViewSource<'_>,
    selection: &ViewSelection<'_>,
    on_held_out: &mut dyn FnMut(ComparedView),
    on_view: &dyn Fn(usize),
) -> Result<ImageProtocols, GpuError> {
    let ViewSource { sequence, map_scale, gpu, cloud } = source;
    let rectifier = Rectifier::new(&sequence.camera, map_scale);
    let mut rasterizer = Rasterizer::new(gpu.clone())?;
    let mut on_gpu = GpuCloud::new(gpu, cloud.sh_degree, cloud.len())?;
    on_gpu.append(gpu, cloud)?;
    let [mut held_out, mut map_colors, mut all_frames, mut monogs] = [ImageMeans::default(); 4];
    for (batch, poses) in selection.poses.chunks(BATCH).enumerate() {
        on_view(batch * BATCH);
        let indices: Vec<usize> = poses.iter().map(|(index, _)| *index).collect();
        let frames = sequence.load_all(&indices);
        let recorded: Vec<Option<RectifiedImage>> =
            frames.into_par_iter().map(|frame| Some(rectifier.rectify(&frame.ok()?))).collect();
        let mut views = Vec::new();
        for ((index, world_from_camera), recorded) in poses.iter().zip(recorded) {
            let Some(recorded) = recorded else { continue };
            let camera = ViewCamera { pinhole: recorded.pinhole, camera_from_world: world_from_camera.inverse() };
            views.push((*index, rasterizer.render(&on_gpu, &camera, [0.0; 3])?, recorded));
        }
        let exposed = |(index, mut rendered, recorded): (usize, Rendered, RectifiedImage)| {
            let in_map_colors = compare(&rendered, &recorded);
            let exposures = Some(selection.exposures).filter(|e| !e.is_empty() && (selection.is_held_out)(index));
            let exposed = exposures.map(|exposures| {
                rendered.expose(&exposures.at(sequence.entries[index].timestamp_s));
                compare(&rendered, &recorded)
            });
            (index, rendered, recorded, in_map_colors, exposed)
        };
        let views: Vec<_> = views.into_par_iter().map(exposed).collect();
        for (index, rendered, recorded, f, exposed) in views {
            all_frames.add(f.psnr, f.ssim, f.depth_l1);
            if index % MONOGS_EVERY == 0 && !selection.keyframes.contains(&index) {
                monogs.add(f.psnr_lit, f.ssim, f.depth_l1);
            }
            if (selection.is_held_out)(index) {
                if exposed.is_some() {
                    map_colors.add(f.psnr, f.ssim, f.depth_l1);
                }
                let f = exposed.unwrap_or(f);
                held_out.add(f.psnr, f.ssim, f.depth_l1);
                let psnr_db = Some(f.psnr).filter(|psnr| psnr.is_finite());
                let figures = ViewRecord { frame: index, psnr_db, ssim: f.ssim, depth_l1_m: f.depth_l1 };
                on_held_out(ComparedView { figures, recorded: recorded.color, rendered: to_rgb8(&rendered) });
            }
        }
    }
    Ok(ImageProtocols {
        held_out: held_out.figures(),
        held_out_map_colors: map_colors.figures(),
        all_frames: all_frames.figures(),
        monogs: monogs.figures(),
    })
}

fn compare(rendered: &Rendered, recorded: &RectifiedImage) -> ViewFigures {
    let pixels = rendered.color_depth.iter().map(|p| [p[0], p[1], p[2]]).collect();
    let image = ImageF32::new(rendered.width as usize, rendered.height as usize, pixels).expect("one colour a pixel").clamped();
    let truth = ImageF32::from_rgb8(&recorded.color);
    let same_size = "both are at the mapping resolution";
    let depth: Vec<f32> = (0..rendered.color_depth.len()).map(|i| rendered.expected_depth(i)).collect();
    ViewFigures {
        psnr: psnr(&image, &truth).expect(same_size),
        psnr_lit: psnr_where_lit(&image, &truth).expect(same_size),
        ssim: ssim(&image, &truth).expect(same_size),
        depth_l1: recorded.depth.as_ref().and_then(|sensor| depth_l1(&depth, &sensor.metres)),
    }
}

/// The rendered colours as an 8-bit image.
pub fn to_rgb8(rendered: &Rendered) -> RgbImage {
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    RgbImage::from_fn(rendered.width, rendered.height, |x, y| {
        let p = rendered.color_depth[(y * rendered.width + x) as usize];
        Rgb([byte(p[0]), byte(p[1]), byte(p[2])])
    })
}
