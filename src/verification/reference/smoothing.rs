//! The smoothing of an antialiased map in space (Yu et al. 2024); twin of its part in `shaders/shared/projection.wgsl`.

use nalgebra::Vector3;

use super::Gaussian64;
use crate::splat::model;

/// Squares of the scales after the smoothing in units of those before it.
fn growth(g: &Gaussian64, interval: f64) -> Vector3<f64> {
    g.log_scale.map(|log_scale| 1.0 + (model::SMOOTHING * interval / log_scale.exp()).powi(2))
}

/// The Gaussian, convolved; the opacity shrinks as the volume grows.
pub fn smooth(g: &Gaussian64, interval: f64) -> Gaussian64 {
    let growth = growth(g, interval);
    let opacity = 1.0 / (1.0 + (-g.raw_opacity).exp()) / growth.product().sqrt();
    let raw_opacity = (opacity / (1.0 - opacity)).ln();
    Gaussian64 { log_scale: g.log_scale + 0.5 * growth.map(f64::ln), raw_opacity, ..g.clone() }
}

/// The gradient by the Gaussian from that by the smoothed one.
pub fn smooth_backward(g: &Gaussian64, interval: f64, by_smoothed: &Gaussian64) -> Gaussian64 {
    let kept = growth(g, interval).map(f64::recip);
    let opacity = |raw: f64| 1.0 / (1.0 + (-raw).exp());
    let by_log_opacity = by_smoothed.raw_opacity / (1.0 - opacity(smooth(g, interval).raw_opacity));
    Gaussian64 {
        log_scale: kept.component_mul(&by_smoothed.log_scale) + by_log_opacity * kept.map(|kept| 1.0 - kept),
        raw_opacity: by_log_opacity * (1.0 - opacity(g.raw_opacity)),
        ..by_smoothed.clone()
    }
}
