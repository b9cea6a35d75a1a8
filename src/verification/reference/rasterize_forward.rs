//! Front-to-back blending, every Gaussian at every pixel; twin of `shaders/rasterize_forward.wgsl`.

use nalgebra::{Vector2, Vector3};

use super::project_forward::{Projected64, project};
use super::{Cutoffs, Gaussian64, Image64, View64};
use crate::splat::model::{self, Surface};

/// The projected Gaussians with their indices, nearest first; ties keep the order of the map.
pub fn sorted(view: &View64, cloud: &[Gaussian64]) -> Vec<(usize, Projected64)> {
    let mut visible: Vec<_> = cloud.iter().enumerate().filter_map(|(i, g)| Some((i, project(view, g)?))).collect();
    // The GPU's keys are f32.
    visible.sort_by_key(|(_, projected)| model::depth_key(projected.depth as f32));
    visible
}

/// How a Gaussian acts on one pixel.
pub(super) struct Contribution {
    pub index: usize,
    pub alpha: f64,
    /// Whether alpha is at its cap and no longer depends on shape and opacity.
    pub capped: bool,
    /// Pixel minus mean.
    pub offset: Vector2<f64>,
    /// Transmittance in front of it.
    pub transmittance: f64,
}

/// All contributions to the pixel `(x, y)`, front to back, and the transmittance left.
pub(super) fn contributions(view: &View64, sorted: &[(usize, Projected64)], x: u32, y: u32) -> (Vec<Contribution>, f64) {
    let mut transmittance = 1.0;
    let mut found = Vec::new();
    for (index, (_, g)) in sorted.iter().enumerate() {
        let offset = Vector2::new(f64::from(x), f64::from(y)) - g.mean;
        let power = -0.5 * (offset.transpose() * g.conic * offset)[0];
        if view.cutoffs == Cutoffs::Sharp && power + g.cut < 0.0 {
            continue;
        }
        let raw = g.opacity * power.exp();
        let alpha = raw.min(model::ALPHA_MAX);
        let next = transmittance * (1.0 - alpha);
        if view.cutoffs == Cutoffs::Sharp && next < model::TRANSMITTANCE_MIN {
            break;
        }
        found.push(Contribution { index, alpha, capped: raw > model::ALPHA_MAX, offset, transmittance });
        transmittance = next;
    }
    (found, transmittance)
}

/// How far f32 can be trusted with a view, or with a pixel of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Conditioning {
    /// (Gaussian, pixel) pairs so close to a cut-off, or to another one's depth, that rounding may decide them either way.
    pub near_cutoffs: usize,
    /// Largest rounding error of an exponent that counts.
    pub exponent_error: f64,
}

/// Judges a view; `slack` is the relative width of the band around the cut-offs.
pub fn conditioning(view: &View64, cloud: &[Gaussian64], slack: f64) -> Conditioning {
    pixel_conditioning(view, cloud, slack).into_iter().fold(Conditioning::default(), |all, pixel| Conditioning {
        near_cutoffs: all.near_cutoffs + pixel.near_cutoffs,
        exponent_error: all.exponent_error.max(pixel.exponent_error),
    })
}

/// Conditioning of each pixel, `[H * W]`.
pub fn pixel_conditioning(view: &View64, cloud: &[Gaussian64], slack: f64) -> Vec<Conditioning> {
    let sorted = sorted(view, cloud);
    let p = &view.camera.pinhole;
    let pixel = |(x, y): (u32, u32)| {
        let mut judged = Conditioning::default();
        for (_, g) in &sorted {
            let d = Vector2::new(f64::from(x), f64::from(y)) - g.mean;
            let power = -0.5 * (d.transpose() * g.conic * d)[0];
            let terms = 0.5 * (d.abs().transpose() * g.conic.abs() * d.abs())[0];
            // A few roundings of the largest term, and of the mean itself.
            let by_mean = (g.conic * d).abs().dot(&g.mean.abs());
            let error = 4.0 * f64::from(f32::EPSILON) * (terms + by_mean);
            if power + g.cut > -error {
                judged.exponent_error = judged.exponent_error.max(error);
            }
            let capped = g.opacity * power.exp() / model::ALPHA_MAX - 1.0;
            let near = (power + g.cut).abs() < slack * (1.0 + power.abs()) + error || capped.abs() < slack + error;
            judged.near_cutoffs += usize::from(near);
        }
        let (found, transmittance) = contributions(view, &sorted, x, y);
        let finishing = transmittance < model::TRANSMITTANCE_MIN * 1.02 || found.iter().any(|c| c.transmittance < 1e-3);
        let order_is_open = |pair: &[Contribution]| {
            let [(i, a), (k, b)] = [0, 1].map(|side| &sorted[pair[side].index]);
            // A depth in f32 is off by a few roundings of its terms. Equal means have equal depths, and keep the map's order.
            let terms = cloud[*i].mean.abs().sum() + cloud[*k].mean.abs().sum() + a.depth;
            (b.depth - a.depth).abs() < 4.0 * f64::from(f32::EPSILON) * terms && cloud[*i].mean != cloud[*k].mean
        };
        judged.near_cutoffs += usize::from(finishing) + found.windows(2).filter(|pair| order_is_open(pair)).count();
        judged
    };
    (0..p.height).flat_map(|y| (0..p.width).map(move |x| (x, y))).map(pixel).collect()
}

/// Renders the map.
pub fn render(view: &View64, cloud: &[Gaussian64]) -> Image64 {
    let sorted = sorted(view, cloud);
    let p = &view.camera.pinhole;
    let mut image = Image64::default();
    for (x, y) in (0..p.height).flat_map(|y| (0..p.width).map(move |x| (x, y))) {
        let (found, transmittance) = contributions(view, &sorted, x, y);
        let colors = found.iter().map(|c| sorted[c.index].1.color * (c.alpha * c.transmittance));
        image.color.push(colors.sum::<Vector3<f64>>() + view.background * transmittance);
        image.depth.push(found.iter().map(|c| sorted[c.index].1.depth_at(&c.offset) * (c.alpha * c.transmittance)).sum());
        image.transmittance.push(transmittance);
        let surface = |c: &Contribution| {
            let (g, weight) = (&sorted[c.index].1, c.alpha * c.transmittance);
            Vector3::new(g.slope.x, g.slope.y, g.depth_at(&c.offset).powi(2)) * weight
        };
        image.surface.push(if view.surface == Surface::Planar { found.iter().map(surface).sum() } else { Vector3::zeros() });
        let half = found.iter().rev().find(|c| c.transmittance > 0.5).filter(|_| transmittance < 0.5);
        image.median_depth.push(half.map_or(0.0, |c| sorted[c.index].1.depth_at(&c.offset)));
    }
    image
}
