//! Views of a map that may be larger than the GPU's memory: what is in view is divided by depth into slabs that fit, which are rendered front to back
//! and blended over each other.

use std::sync::Arc;

use rayon::prelude::*;

use super::{GpuCloud, Rasterizer, Rendered};
use crate::gpu::{Gpu, GpuError};
use crate::splat::model::{FAR_METRES, NEAR_METRES, Surface, depth_key};
use crate::splat::{GaussianCloud, ViewCamera};

/// Slabs behind are left out where so little of the light reaches them at every pixel.
const LEAST_LIGHT: f32 = 1e-3;
/// A Gaussian is drawn up to fewer standard deviations than this, and its footprint is dilated by less than so many pixels.
const EXTENT: f32 = 4.0;
const DILATION_PIXELS: f32 = 4.0;

/// Renders a map that is on the host.
#[derive(Debug)]
pub struct MapRenderer<'a> {
    gpu: Arc<Gpu>,
    rasterizer: Rasterizer,
    map: &'a GaussianCloud,
    /// The whole map, or the present slab.
    on_gpu: GpuCloud,
    /// Most Gaussians of a slab; `None` where the whole map is on the GPU.
    most: Option<usize>,
}

impl<'a> MapRenderer<'a> {
    /// Of a map with this surface, of which at most `most` Gaussians are on the GPU at a time.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn new(gpu: &Arc<Gpu>, map: &'a GaussianCloud, surface: Surface, most: usize) -> Result<Self, GpuError> {
        let most = Some(most.max(1)).filter(|most| map.len() > *most);
        let on_gpu = match most {
            None => GpuCloud::of(gpu, map)?,
            Some(most) => GpuCloud::new(gpu, map.sh_degree, most)?.with_antialiasing(map.antialiased),
        };
        Ok(Self { rasterizer: Rasterizer::of_surface(gpu.clone(), surface)?, gpu: gpu.clone(), map, on_gpu, most })
    }

    /// Renders a view over black. In slabs, a pixel differs by less than a hundredth at the very most: where blending would have ended with light left.
    ///
    /// # Errors
    /// [`GpuError`] if a buffer does not fit or the device fails.
    pub fn render(&mut self, camera: &ViewCamera) -> Result<Rendered, GpuError> {
        let Some(most) = self.most else { return self.rasterizer.render(&self.on_gpu, camera, [0.0; 3]) };
        let in_view = in_view(self.map, camera);
        let mut slabs = in_view.chunks(most);
        let mut picture = self.slab(slabs.next().unwrap_or_default(), camera)?;
        for slab in slabs {
            if picture.transmittance.iter().all(|light| *light < LEAST_LIGHT) {
                break;
            }
            let behind = self.slab(slab, camera)?;
            picture.blend_over(&behind);
        }
        Ok(picture)
    }

    fn slab(&mut self, slab: &[(u32, u32)], camera: &ViewCamera) -> Result<Rendered, GpuError> {
        self.on_gpu.clear();
        self.on_gpu.append(&self.gpu, &self.map.picked(slab.iter().map(|(_, gaussian)| *gaussian as usize)))?;
        self.rasterizer.render(&self.on_gpu, camera, [0.0; 3])
    }
}

/// Gaussians that may be in view, front to back: depth keys and places. Those of one key are in map order, as the rasterizer draws them.
fn in_view(map: &GaussianCloud, camera: &ViewCamera) -> Vec<(u32, u32)> {
    let (axes, translation) = camera.rows();
    let p = &camera.pinhole;
    // Slopes of the sides of the view, the dilation included, and how a distance along an axis becomes one from a side.
    let side = |focal: f64, middle: f64, size: u32| {
        let slope = |pixel: f64| (pixel / focal) as f32;
        let margin = f64::from(DILATION_PIXELS);
        let (low, high) = (slope(-middle - margin), slope(f64::from(size) - middle + margin));
        move |center: f32, depth: f32, reach: f32| {
            let beyond = |slope: f32| reach * (1.0 + slope * slope).sqrt();
            center + beyond(low) > low * depth && center - beyond(high) < high * depth
        }
    };
    let (across, down) = (side(p.fx, p.cx, p.width), side(p.fy, p.cy, p.height));
    let key = |i: usize| {
        let along = |axis: usize| axes[axis].dot(map.means[i]) + translation[axis];
        let depth = along(2);
        let reach = EXTENT * map.log_scales[i].max_element().exp();
        let is_drawn = depth >= NEAR_METRES as f32 && depth <= FAR_METRES as f32;
        (is_drawn && across(along(0), depth, reach) && down(along(1), depth, reach)).then(|| (depth_key(depth), i as u32))
    };
    let mut keys: Vec<(u32, u32)> = (0..map.len()).into_par_iter().filter_map(key).collect();
    keys.par_sort_unstable();
    keys
}
