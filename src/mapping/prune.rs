//! Which Gaussians are not worth keeping: faint ones, oversized ones, and any that went bad.

use super::PruneConfig;
use crate::gpu::{Gpu, GpuError};
use crate::render::GpuCloud;
use crate::splat::opacity_from_raw;

/// Indices of the Gaussians to keep, ascending.
pub(super) fn plan(gpu: &Gpu, cloud: &GpuCloud, config: &PruneConfig) -> Result<Vec<u32>, GpuError> {
    let geometry = cloud.read_plane(gpu, 0)?;
    let scales = cloud.read_plane(gpu, 1)?;
    let max_log_scale = config.max_scale_metres.ln();
    let worth = |i: &usize| {
        let [x, y, z, raw_opacity] = geometry[*i];
        let finite = x.is_finite() && y.is_finite() && z.is_finite();
        finite && opacity_from_raw(raw_opacity) >= config.min_opacity && scales[*i][..3].iter().all(|s| *s <= max_log_scale)
    };
    Ok((0..cloud.len()).filter(worth).map(|i| i as u32).collect())
}
