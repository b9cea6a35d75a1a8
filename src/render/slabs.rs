//! Views of a map that may be larger than the GPU's memory: what is in view is divided by depth into slabs that fit, which are rendered front to back
//! and blended over each other. What lies behind covered pixels is left out.

use std::borrow::Borrow;
use std::sync::Arc;

use rayon::prelude::*;

use super::{GpuCloud, Rasterizer, Rendered};
use crate::gpu::{Gpu, GpuError};
use crate::splat::model::{ALPHA_MIN, DILATION, FAR_METRES, NEAR_METRES, Surface, depth_key, tangent_bounds};
use crate::splat::{GaussianCloud, ViewCamera};

/// A pixel is covered where less of the light than this reaches what lies behind.
const LEAST_LIGHT: f32 = 1e-3;
/// The first slab has this share of the Gaussians that fit; each next one is twice as large, until all fit. Most of what fits may be covered already.
const FIRST_SLAB_DIVISOR: usize = 8;
/// Pixels that rounding may add to a footprint.
const ROUNDING_PIXELS: f32 = 0.5;

/// Renders a map that is on the host: one borrowed, or shared.
#[derive(Debug)]
pub struct MapRenderer<M> {
    gpu: Arc<Gpu>,
    rasterizer: Rasterizer,
    map: M,
    /// The whole map, or the present slab.
    on_gpu: GpuCloud,
    /// Most Gaussians of a slab; `None` where the whole map is on the GPU.
    most: Option<usize>,
}

impl<M: Borrow<GaussianCloud>> MapRenderer<M> {
    /// Of a map with this surface, of which at most `most` Gaussians are on the GPU at a time, and no more than it binds.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Arc<Gpu>, map: M, surface: Surface, most: usize) -> Result<Self, GpuError> {
        let cloud: &GaussianCloud = map.borrow();
        let most = Some(most.min(GpuCloud::most_bound(gpu, cloud.sh_degree)).max(1)).filter(|most| cloud.len() > *most);
        let on_gpu = match most {
            None => GpuCloud::of(gpu, cloud)?,
            Some(most) => GpuCloud::new(gpu, cloud.sh_degree, most)?.with_antialiasing(cloud.antialiased),
        };
        Ok(Self { rasterizer: Rasterizer::of_surface(gpu.clone(), surface)?, gpu: gpu.clone(), map, on_gpu, most })
    }

    /// Renders a view over black. In slabs, the light that a pixel lets through differs by less than a hundredth: where blending would have ended with light left.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, camera: &ViewCamera) -> Result<Rendered, GpuError> {
        let Some(most) = self.most else { return self.rasterizer.render(&self.on_gpu, camera, [0.0; 3]) };
        let mut in_view = in_view(self.map.borrow(), camera);
        let mut size = (most / FIRST_SLAB_DIVISOR).max(1).min(in_view.len());
        let mut picture = self.slab(&in_view[..size], camera)?;
        let mut done = size;
        while done < in_view.len() {
            let light = Light::of(&picture);
            in_view = in_view[done..].par_iter().filter(|footprint| light.reaches(footprint)).copied().collect();
            size = (2 * size).min(most).min(in_view.len());
            if size > 0 {
                picture.blend_over(&self.slab(&in_view[..size], camera)?);
            }
            done = size;
        }
        Ok(picture)
    }

    fn slab(&mut self, slab: &[Footprint], camera: &ViewCamera) -> Result<Rendered, GpuError> {
        self.on_gpu.clear();
        self.on_gpu.append(&self.gpu, &self.map.borrow().picked(slab.iter().map(|footprint| footprint.gaussian as usize)))?;
        self.rasterizer.render(&self.on_gpu, camera, [0.0; 3])
    }
}

/// A Gaussian that may be in view.
#[derive(Clone, Copy, Debug)]
struct Footprint {
    depth_key: u32,
    gaussian: u32,
    /// Pixels that it may touch: first ones, and the ones after the last.
    columns: [u16; 2],
    rows: [u16; 2],
}

/// Where light reaches what lies behind: a summed-area table (Crow 1984) of the pixels that are not covered.
struct Light {
    stride: usize,
    /// `[H + 1, W + 1]` how many pixels above and to the left are not covered.
    sums: Vec<u32>,
}

impl Light {
    fn of(picture: &Rendered) -> Self {
        let (width, height) = (picture.width as usize, picture.height as usize);
        let stride = width + 1;
        let mut sums = vec![0; stride * (height + 1)];
        for y in 0..height {
            let mut row = 0;
            for x in 0..width {
                row += u32::from(picture.transmittance[y * width + x] >= LEAST_LIGHT);
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        Self { stride, sums }
    }

    fn reaches(&self, footprint: &Footprint) -> bool {
        let sum = |x: u16, y: u16| self.sums[usize::from(y) * self.stride + usize::from(x)];
        let ([left, right], [top, bottom]) = (footprint.columns, footprint.rows);
        sum(right, bottom) + sum(left, top) > sum(left, bottom) + sum(right, top)
    }
}

/// Gaussians that may be in view, front to back. Those of one depth key are in map order, as the rasterizer draws them.
fn in_view(map: &GaussianCloud, camera: &ViewCamera) -> Vec<Footprint> {
    let (axes, translation) = camera.rows();
    let p = &camera.pinhole;
    let bounds = tangent_bounds(p).map(|tangent| tangent as f32);
    let across = side((p.fx, p.cx, p.width), [bounds[0], bounds[1]]);
    let down = side((p.fy, p.cy, p.height), [bounds[2], bounds[3]]);
    let footprint = |i: usize| {
        let along = |axis: usize| axes[axis].dot(map.means[i]) + translation[axis];
        let depth = along(2);
        // Alpha falls to ALPHA_MIN where half the squared distance in standard deviations equals the cut.
        let cut = -(-map.raw_opacities[i]).exp().ln_1p() - (ALPHA_MIN as f32).ln();
        if !(depth >= NEAR_METRES as f32 && depth <= FAR_METRES as f32 && cut >= 0.0) {
            return None;
        }
        let deviation = map.log_scales[i].max_element().exp() / depth;
        let deviations = (2.0 * cut).sqrt();
        let columns = across(along(0) / depth, deviation, deviations)?;
        let rows = down(along(1) / depth, deviation, deviations)?;
        Some(Footprint { depth_key: depth_key(depth), gaussian: i as u32, columns, rows })
    };
    let mut footprints: Vec<_> = (0..map.len()).into_par_iter().filter_map(footprint).collect();
    footprints.par_sort_unstable_by_key(|footprint| (footprint.depth_key, footprint.gaussian));
    footprints
}

/// The pixels along one side of the picture, of this focal length, middle and size, that a Gaussian at a tangent may touch up to so many standard
/// deviations. The largest standard deviation is a tangent too. The Jacobian's row is (f/z, -f t/z), where t is the tangent inside its bounds.
fn side((focal, middle, size): (f64, f64, u32), bounds: [f32; 2]) -> impl Fn(f32, f32, f32) -> Option<[u16; 2]> {
    let (focal, middle, size) = (focal as f32, middle as f32, size as f32);
    move |tangent, deviation, deviations| {
        let seen = tangent.clamp(bounds[0], bounds[1]);
        let variance = (focal * deviation).powi(2) * (1.0 + seen * seen) + DILATION as f32;
        let reach = deviations * variance.sqrt() + ROUNDING_PIXELS;
        let center = focal * tangent + middle;
        let (first, end) = ((center - reach).floor().max(0.0), ((center + reach).ceil() + 1.0).min(size));
        (first < end).then_some([first as u16, end as u16])
    }
}
