//! Renders the final map at estimated poses and compares with what the camera recorded, by the three protocols in use.
//!
//! Images are compared at the mapping resolution, without lens distortion, with the camera's own principal point, over the pixels that the
//! camera recorded.

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
use crate::sequence::{RectifiedImage, Rectifier, Rectifiers, Sequence};
use crate::splat::GaussianCloud;
use crate::splat::ViewCamera;
use crate::splat::model::Surface;

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
    /// SSIM over the recorded pixels.
    pub ssim: f64,
    /// Where the sensor has depth.
    pub depth_l1_m: Option<f64>,
}

#[derive(Clone, Copy)]
struct ViewFigures {
    psnr: f64,
    psnr_lit: f64,
    ssim: f64,
    depth_l1: Option<f64>,
}

/// Which protocols a view belongs to.
#[derive(Clone, Copy)]
struct ViewRole {
    frame: usize,
    is_keyframe: bool,
    is_held_out: bool,
}

/// Means of the views so far, by protocol.
#[derive(Default)]
struct ProtocolMeans {
    held_out: ImageMeans,
    map_colors: ImageMeans,
    all_frames: ImageMeans,
    monogs: ImageMeans,
}

impl ProtocolMeans {
    /// Counts a view in by its figures in the map's own colours and, where that is corrected, with its exposure. Returns the record of a
    /// held-out view.
    fn add(&mut self, role: ViewRole, own: ViewFigures, exposed: Option<ViewFigures>) -> Option<ViewRecord> {
        self.all_frames.add(own.psnr, own.ssim, own.depth_l1);
        if role.frame.is_multiple_of(MONOGS_EVERY) && !role.is_keyframe {
            self.monogs.add(own.psnr_lit, own.ssim, own.depth_l1);
        }
        if !role.is_held_out {
            return None;
        }
        if exposed.is_some() {
            self.map_colors.add(own.psnr, own.ssim, own.depth_l1);
        }
        let f = exposed.unwrap_or(own);
        self.held_out.add(f.psnr, f.ssim, f.depth_l1);
        let psnr_db = Some(f.psnr).filter(|psnr| psnr.is_finite());
        Some(ViewRecord { frame: role.frame, psnr_db, ssim: f.ssim, depth_l1_m: f.depth_l1 })
    }

    fn figures(&self) -> ImageProtocols {
        ImageProtocols {
            held_out: self.held_out.figures(),
            held_out_map_colors: self.map_colors.figures(),
            all_frames: self.all_frames.figures(),
            monogs: self.monogs.figures(),
        }
    }
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
    /// Whose depth is compared.
    pub surface: Surface,
}

/// Compares all posed views with their renders. Frames that cannot be read or are masked wholly are left out. `on_held_out` receives each held-out view, `on_view`
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
    let ViewSource { sequence, map_scale, gpu, cloud, surface } = source;
    let mut rectifiers = Rectifiers::new(map_scale);
    let mut rasterizer = Rasterizer::of_surface(gpu.clone(), surface)?;
    let on_gpu = GpuCloud::of(gpu, cloud)?;
    let mut means = ProtocolMeans::default();
    for (batch, poses) in selection.poses.chunks(BATCH).enumerate() {
        on_view(batch * BATCH);
        let indices: Vec<usize> = poses.iter().map(|(index, _)| *index).collect();
        let frames = sequence.load_all(&indices);
        let rectifiers: Vec<Arc<Rectifier>> = indices.iter().map(|index| rectifiers.of(sequence.camera_of(*index))).collect();
        let recorded: Vec<Option<RectifiedImage>> = rectifiers
            .par_iter()
            .zip(frames)
            .map(|(rectifier, frame)| Some(rectifier.rectify(&frame.ok()?)).filter(shows_anything))
            .collect();
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
        for (frame, rendered, recorded, own, exposed) in views {
            let is_keyframe = selection.keyframes.contains(&frame);
            let role = ViewRole { frame, is_keyframe, is_held_out: (selection.is_held_out)(frame) };
            if let Some(figures) = means.add(role, own, exposed) {
                on_held_out(ComparedView { figures, recorded: recorded.color, rendered: to_rgb8(&rendered) });
            }
        }
    }
    Ok(means.figures())
}

fn shows_anything(image: &RectifiedImage) -> bool {
    image.valid.as_ref().is_none_or(|valid| valid.contains(&true))
}

fn compare(rendered: &Rendered, recorded: &RectifiedImage) -> ViewFigures {
    let pixels = rendered.color_depth.iter().map(|p| [p[0], p[1], p[2]]).collect();
    let image = ImageF32::new(rendered.width as usize, rendered.height as usize, pixels).expect("one colour a pixel").clamped();
    let truth = ImageF32::from_rgb8(&recorded.color).masked(recorded.valid.as_ref());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pinhole;
    use crate::sequence::DepthImage;

    const SIZE: u32 = 16;

    fn figures(psnr: f64) -> ViewFigures {
        ViewFigures { psnr, psnr_lit: psnr + 0.5, ssim: psnr / 100.0, depth_l1: None }
    }

    #[test]
    fn a_view_counts_in_its_protocols() {
        let mut means = ProtocolMeans::default();
        let role = |frame, is_keyframe, is_held_out| ViewRole { frame, is_keyframe, is_held_out };
        assert_eq!(means.add(role(0, true, false), figures(10.0), None), None);
        assert_eq!(means.add(role(5, false, false), figures(20.0), None), None);
        assert_eq!(means.add(role(6, false, false), figures(30.0), None), None);
        let record = ViewRecord { frame: 8, psnr_db: Some(50.0), ssim: 0.5, depth_l1_m: None };
        assert_eq!(means.add(role(8, false, true), figures(40.0), Some(figures(50.0))), Some(record));
        let equal = means.add(role(16, false, true), figures(f64::INFINITY), None).unwrap();
        assert_eq!((equal.frame, equal.psnr_db), (16, None));
        let figures = means.figures();
        let of = |f: Option<crate::evaluation::metrics::ImageFigures>| f.map(|f| (f.count, f.psnr_db));
        assert_eq!(of(figures.all_frames), Some((5, None)));
        assert_eq!(of(figures.monogs), Some((1, Some(20.5))), "frame 0 is a keyframe, the others are no fifth ones");
        assert_eq!(of(figures.held_out_map_colors), Some((1, Some(40.0))), "where exposures are corrected");
        assert_eq!(figures.held_out.map(|f| f.count), Some(2));
    }

    #[test]
    fn a_render_is_compared_by_colour_and_expected_depth() {
        let pixels = (SIZE * SIZE) as usize;
        // Half covered at 1 m of depth's sum: 2 m. Beyond white counts as white.
        let rendered = Rendered {
            width: SIZE,
            height: SIZE,
            color_depth: vec![[1.5, 0.2, -0.5, 1.0]; pixels],
            transmittance: vec![0.5; pixels],
            surface: Vec::new(),
        };
        let bytes = to_rgb8(&rendered);
        assert!(bytes.dimensions() == (SIZE, SIZE) && bytes.pixels().all(|p| p.0 == [255, 51, 0]));
        let pinhole = Pinhole { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0, width: SIZE, height: SIZE };
        let depth = DepthImage { width: SIZE, height: SIZE, metres: vec![2.5; pixels] };
        let mut recorded = RectifiedImage { pinhole, color: bytes, depth: Some(depth), valid: None };
        let f = compare(&rendered, &recorded);
        assert!(f.psnr > 100.0 && f.psnr_lit > 100.0 && f.ssim > 0.999, "equal colours");
        assert!((f.depth_l1.unwrap() - 0.5).abs() < 1e-6);
        recorded.color.put_pixel(8, 8, Rgb([0, 51, 0]));
        let f = compare(&rendered, &recorded);
        assert!((f.psnr - 10.0 * f64::from(3 * SIZE * SIZE).log10()).abs() < 1e-3, "one channel of one pixel is off by one");
        assert!(f.ssim < 0.9999);
        recorded.valid = Some((0..pixels).map(|i| i != 8 * SIZE as usize + 8).collect());
        assert!(compare(&rendered, &recorded).psnr > 100.0, "the pixel was not recorded");
    }

    #[test]
    fn pixels_are_bytes_row_by_row() {
        let color_depth = vec![[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let image = to_rgb8(&Rendered { width: 2, height: 2, color_depth, transmittance: vec![0.0; 4], surface: Vec::new() });
        assert_eq!(image.into_raw(), [0, 0, 0, 255, 0, 0, 0, 255, 0, 0, 0, 255]);
    }
}
