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
use crate::render::{MapRenderer, Rendered};
use crate::sequence::{RectifiedImage, Rectifier, Rectifiers, Sequence};
use crate::splat::GaussianCloud;
use crate::splat::ViewCamera;
use crate::splat::model::Surface;

/// MonoGS compares every 5th frame.
const MONOGS_EVERY: usize = 5;
/// Views of a batch.
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

/// A view's figures in the map's own colours and, where that is corrected, with its exposure.
#[derive(Clone, Copy)]
struct Compared {
    role: ViewRole,
    own: ViewFigures,
    exposed: Option<ViewFigures>,
}

impl Compared {
    /// Of a held-out view.
    fn record(&self) -> Option<ViewRecord> {
        let f = self.exposed.unwrap_or(self.own);
        let psnr_db = Some(f.psnr).filter(|psnr| psnr.is_finite());
        self.role.is_held_out.then_some(ViewRecord { frame: self.role.frame, psnr_db, ssim: f.ssim, depth_l1_m: f.depth_l1 })
    }
}

impl ProtocolMeans {
    /// Counts a view in and returns its record.
    fn add(&mut self, view: Compared) -> Option<ViewRecord> {
        let Compared { role, own, exposed } = view;
        self.all_frames.add(own.psnr, own.ssim, own.depth_l1);
        if role.frame.is_multiple_of(MONOGS_EVERY) && !role.is_keyframe {
            self.monogs.add(own.psnr_lit, own.ssim, own.depth_l1);
        }
        if role.is_held_out {
            if exposed.is_some() {
                self.map_colors.add(own.psnr, own.ssim, own.depth_l1);
            }
            let f = exposed.unwrap_or(own);
            self.held_out.add(f.psnr, f.ssim, f.depth_l1);
        }
        view.record()
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
    /// Most of its Gaussians on the adapter at a time.
    pub most_gaussians: usize,
    /// Whose depth is compared.
    pub surface: Surface,
}

/// A posed frame as the camera recorded it.
struct RecordedView {
    frame: usize,
    world_from_camera: Se3,
    image: RectifiedImage,
}

/// Compares all posed views with their renders; returns the means by protocol and the held-out views' records in order. Frames that cannot be read or are masked
/// wholly are left out. `on_held_out` receives each held-out view, several at a time, `on_view` the number of views done.
///
/// # Errors
/// If the adapter fails.
pub fn evaluate_views(
    source: ViewSource<'_>,
    selection: &ViewSelection<'_>,
    on_held_out: &(dyn Fn(&ComparedView) + Sync),
    on_view: &dyn Fn(usize),
) -> Result<(ImageProtocols, Vec<ViewRecord>), GpuError> {
    let ViewSource { sequence, map_scale, gpu, cloud, most_gaussians, surface } = source;
    let mut rectifiers = Rectifiers::new(map_scale);
    let mut renderer = MapRenderer::new(gpu, cloud, surface, most_gaussians)?;
    let mut load = |poses: &[(usize, Se3)]| load_views(sequence, &mut rectifiers, poses);
    let mut render = |recorded: Vec<RecordedView>| -> Result<Vec<(RecordedView, Rendered)>, GpuError> {
        let camera = |v: &RecordedView| ViewCamera { pinhole: v.image.pinhole, camera_from_world: v.world_from_camera.inverse() };
        recorded.into_iter().map(|view| renderer.render(&camera(&view)).map(|r| (view, r))).collect()
    };
    let compare = |views: Vec<_>| -> Vec<Compared> {
        views.into_par_iter().map(|view| compare_view(sequence, selection, view, on_held_out)).collect()
    };
    let mut means = ProtocolMeans::default();
    let mut records = Vec::new();
    let (mut recorded, mut rendered) = (Vec::new(), Vec::new());
    // Three batches at a time: one is decoded, one rendered and one compared. Two rounds without new poses empty the pipeline.
    for (round, poses) in selection.poses.chunks(BATCH).chain([&[] as &[_]; 2]).enumerate() {
        let (to_render, to_compare) = (std::mem::take(&mut recorded), std::mem::take(&mut rendered));
        let ((next, renders), compared) =
            rayon::join(|| rayon::join(|| load(poses), || render(to_render)), || compare(to_compare));
        (recorded, rendered) = (next, renders?);
        records.extend(compared.into_iter().filter_map(|view| means.add(view)));
        on_view((round.saturating_sub(1) * BATCH).min(selection.poses.len()));
    }
    Ok((means.figures(), records))
}

fn load_views(sequence: &Sequence, rectifiers: &mut Rectifiers, poses: &[(usize, Se3)]) -> Vec<RecordedView> {
    let indices: Vec<usize> = poses.iter().map(|(index, _)| *index).collect();
    let frames = sequence.load_all(&indices);
    let rectifiers: Vec<Arc<Rectifier>> = indices.iter().map(|index| rectifiers.of(sequence.camera_of(*index))).collect();
    let rectified = rectifiers.par_iter().zip(frames).zip(poses).filter_map(|((rectifier, frame), (frame_index, pose))| {
        let image = Some(rectifier.rectify(&frame.ok()?)).filter(shows_anything)?;
        Some(RecordedView { frame: *frame_index, world_from_camera: *pose, image })
    });
    rectified.collect()
}

fn compare_view(
    sequence: &Sequence,
    selection: &ViewSelection<'_>,
    (recorded, mut rendered): (RecordedView, Rendered),
    on_held_out: &(dyn Fn(&ComparedView) + Sync),
) -> Compared {
    let frame = recorded.frame;
    let is_held_out = (selection.is_held_out)(frame);
    let role = ViewRole { frame, is_keyframe: selection.keyframes.contains(&frame), is_held_out };
    let own = compare(&rendered, &recorded.image);
    let exposures = Some(selection.exposures).filter(|exposures| !exposures.is_empty() && is_held_out);
    let exposed = exposures.map(|exposures| {
        rendered.expose(&exposures.at(sequence.entries[frame].timestamp_s));
        compare(&rendered, &recorded.image)
    });
    let compared = Compared { role, own, exposed };
    if let Some(figures) = compared.record() {
        on_held_out(&ComparedView { figures, recorded: recorded.image.color, rendered: to_rgb8(&rendered) });
    }
    compared
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
        let view = |frame, is_keyframe, is_held_out, own, exposed: Option<f64>| Compared {
            role: ViewRole { frame, is_keyframe, is_held_out },
            own: figures(own),
            exposed: exposed.map(figures),
        };
        assert_eq!(means.add(view(0, true, false, 10.0, None)), None);
        assert_eq!(means.add(view(5, false, false, 20.0, None)), None);
        assert_eq!(means.add(view(6, false, false, 30.0, None)), None);
        let record = ViewRecord { frame: 8, psnr_db: Some(50.0), ssim: 0.5, depth_l1_m: None };
        assert_eq!(means.add(view(8, false, true, 40.0, Some(50.0))), Some(record));
        let equal = means.add(view(16, false, true, f64::INFINITY, None)).unwrap();
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
